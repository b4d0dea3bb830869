# potr_cl with PoCL, an OpenCL runtime for CPUs of any maker.
#
#     docker build -t potr-cl .
#     docker run --rm -v "$PWD:/data" potr-cl encode scene.ply -o scene.potr --cameras cameras.json

FROM debian:trixie-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends python3-venv python3-dev gcc libc6-dev
COPY pyproject.toml setup.py README.md LICENSE MANIFEST.in /source/
COPY potr_cl /source/potr_cl
# pip is needed no more once everything is installed.
RUN python3 -m venv /opt/potr-cl && /opt/potr-cl/bin/pip install --no-cache-dir --no-compile /source \
    && /opt/potr-cl/bin/pip uninstall -y pip

FROM debian:trixie-slim
RUN apt-get update && apt-get install -y --no-install-recommends python3 pocl-opencl-icd \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
COPY --from=build /opt/potr-cl /opt/potr-cl
# Compiled kernels are kept here; anyone may be the user that runs it.
ENV XDG_CACHE_HOME=/tmp/cache POCL_CACHE_DIR=/tmp/cache/pocl PYTHONDONTWRITEBYTECODE=1
WORKDIR /data
ENTRYPOINT ["/opt/potr-cl/bin/python", "-m", "potr_cl"]
