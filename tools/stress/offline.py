"""Every GPU program, compiled for AMD's, Intel's and Apple's GPUs without having one: does it build, and does it spill?

    python -m tools.stress.offline [SOURCE …] [--targets NAME …] [--processes P] [--json FILE]

The programs are those that the kernel files declare (:mod:`tests.reference.gpu_programs`), not those that some encode
happened to build. AMD's are compiled by clang and libclc (Debian: clang-19, libclc-19), Intel's by ocloc (Debian:
intel-opencl-icd, unpacked and not installed: its runtime is of no use without such a GPU; the variable OCLOC names the
program). ``apple`` compiles for nobody: it checks that the programs for devices without extensions are OpenCL C 1.2 to
the letter. A compiler that is not here is left out, and said.

For each kernel the worst of its programs: vector registers, bytes of scratch memory a work-item (arrays that are
indexed while the kernel runs, and what does not fit the registers), waves that a SIMD holds; on Intel's the registers
that are spilled. Scratch is read and written by way of the GPU's memory, where a register costs nothing.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from potr_cl.opencl.source import kernel_source
from tests.reference.gpu_programs import gpu_programs, gpu_sources
from tools.results import Cell, Results
from tools.workloads import plain_parser

AMD = ("gfx906", "gfx90a", "gfx1030", "gfx1100", "gfx1201")
#: Work-items of the narrowest sub-group of each (cl/include/registers.clh).
INTEL = {"tgllp": 8, "dg2": 8, "pvc": 16}
APPLE = "apple"
_VERSIONS = (19, 18, 17, 16)
_CHECKED = ("-pedantic", "-Wall", "-Werror", "-Wno-unused-function", "-Wno-gnu-line-marker", "-Wno-unused-variable")
_LOCAL = 32768


@dataclass(frozen=True)
class Program:
    """A kernel file with values for its macros."""

    source: str
    macros: tuple[tuple[str, str], ...]

    def __str__(self) -> str:
        return " ".join((self.source, *(f"{name}={value}" for name, value in self.macros)))

    @property
    def defines(self) -> list[str]:
        """For a compiler's command line; as GPUs get them that may have a watchdog (:mod:`potr_cl.opencl.pieces`)."""
        return ["-DIN_PIECES=1", *(f"-D{name}={value}" for name, value in self.macros)]


@dataclass(frozen=True, order=True)
class Use:
    """What a kernel takes.

    Attributes:
        scratch: bytes a work-item on AMD's GPUs, spilled registers on Intel's.
        registers: vector registers of a work-item; 0 where the compiler does not say.
        waves: that a SIMD holds; 0 where the compiler does not say.
        local: bytes of local memory.
    """

    scratch: int = 0
    registers: int = 0
    waves: int = 0
    local: int = 0


class OfflineError(RuntimeError):
    """A program is refused by a compiler, or takes what not every GPU has."""


def programs(source: str, target: str = APPLE) -> list[Program]:
    """Those of a kernel file, one of those that differ in floating-point constants only.

    For Intel, whose compiler takes long, the ones with the most SH coefficients: others need no more registers.
    """
    found: dict[object, Program] = {}
    for macros in gpu_programs(source):
        code = tuple((name, value) for name, value in macros.items() if not value.endswith("f"))
        found.setdefault(code, Program(source, tuple(sorted(macros.items()))))
    most = max(int(dict(each.macros).get("SH_COUNT", 0)) for each in found.values())
    return [p for p in found.values() if target not in INTEL or int(dict(p.macros).get("SH_COUNT", 0)) == most]


def clang() -> tuple[str, Path] | None:
    """A clang and the folder of the libclc of its version, if both are here."""
    for version in _VERSIONS:
        path, library = shutil.which(f"clang-{version}"), Path("/usr/lib/clc")
        if path is not None and any(library.glob("gfx*-amdgcn-mesa-mesa3d.bc")):
            return path, library
    return None


def _by_clang(program: Program, target: str, file: Path, *options: str) -> None:
    found = clang()
    assert found is not None
    language = ("-x", "cl", "-cl-std=CL1.2", "-Xclang", "-finclude-default-header")
    _run([found[0], *language, *program.defines, *options, str(file)], program, target)


def compile_for_amd(program: Program, target: str, file: Path) -> dict[str, Use]:
    """What each kernel of a program takes on a GPU of AMD's."""
    found, assembly = clang(), file.with_suffix(".s")
    assert found is not None
    options = ["-target", "amdgcn-mesa-mesa3d", f"-mcpu={target}", "-O3", "-S", "-o", str(assembly)]
    builtins = ["-Xclang", "-mlink-builtin-bitcode", "-Xclang", str(found[1] / f"{target}-amdgcn-mesa-mesa3d.bc")]
    _by_clang(program, target, file, *options, *builtins)
    text, uses = assembly.read_text(), {}
    for match in re.finditer(r"^\s*\.amdgpu_hsa_kernel (\w+)$|^\s*\.globl\s+(\w+)", text, re.MULTILINE):
        info = text[match.end() : text.find("COMPUTE_PGM_RSRC2:TIDIG_COMP_CNT", match.end())]
        figures = [re.search(rf"^; {label}: (\d+)", info, re.MULTILINE) for label in _AMD_LABELS]
        if figures[0] is not None:
            uses[match[1] or match[2]] = Use(*(0 if figure is None else int(figure[1]) for figure in figures))
    return uses


_AMD_LABELS = ("ScratchSize", "NumVgprs", "Occupancy", "LDSByteSize")


def compile_for_intel(program: Program, target: str, file: Path) -> dict[str, Use]:
    """What each kernel of a program spills on a GPU of Intel's."""
    options = " ".join(["-cl-std=CL1.2", *program.defines, f"-DSUB_GROUP={INTEL[target]}"])
    words = ["-file", str(file), "-device", target, "-options", options, "-out_dir", str(file.parent)]
    said = _run([_ocloc() or "", "compile", *words], program, target)
    uses = dict.fromkeys(_kernels(program), Use())
    for name, spilled in re.findall(r"kernel (\w+)\s.*spilled around (\d+)", said):
        uses[name] = max(uses.get(name, Use()), Use(scratch=int(spilled)))
    return uses


def check_for_apple(program: Program, target: str, file: Path) -> dict[str, Use]:
    """Whether a program is OpenCL C 1.2 without any extension, as Apple's compiler takes it; nothing is measured."""
    if ("INT64_ATOMICS", "1") in program.macros:  # for devices with 64-bit atomics
        return {}
    _by_clang(program, target, file, "-target", "spir64", "-Xclang", "-cl-ext=-all", "-fsyntax-only", *_CHECKED)
    return dict.fromkeys(_kernels(program), Use())


def measure(program: Program, target: str) -> dict[str, Use]:
    """What each kernel of a program takes on one target.

    Raises:
        OfflineError: it is refused, or takes more local memory than every GPU has.
    """
    how = check_for_apple if target == APPLE else compile_for_intel if target in INTEL else compile_for_amd
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "program.cl"
        file.write_text(kernel_source(program.source))
        uses = how(program, target, file)
    for name, use in uses.items():
        if use.local > _LOCAL:
            raise OfflineError(f"{program}, {target}: {name} takes {use.local} bytes of local memory, above {_LOCAL}")
    return uses


def available() -> list[str]:
    """The targets whose compilers are here."""
    amd = [APPLE, *AMD] if clang() is not None else []
    return [*amd, *(INTEL if _ocloc() is not None else ())]


def _ocloc() -> str | None:
    return os.environ.get("OCLOC") or shutil.which("ocloc")


def _kernels(program: Program) -> list[str]:
    kernel = r"^kernel\b[^;{(]*?(?:__attribute__\(\(.*?\)\)\)?\s*)?void (\w+)\("
    return re.findall(kernel, kernel_source(program.source), re.MULTILINE | re.DOTALL)


def _run(command: Sequence[str], program: Program, target: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    if done.returncode != 0:
        first = next((line for line in said.splitlines() if "error" in line), said[:300])
        raise OfflineError(f"{program} does not compile for {target}: {first.strip()}")
    return said


def _cell(use: Use | None, target: str) -> Cell:
    if use is None:
        return None
    if target in INTEL:
        return f"{use.scratch} spilled" if use.scratch else "0"
    if target == APPLE:
        return "yes"
    return f"{use.registers} / {use.scratch} / {use.waves}"


def main() -> None:
    """Compile all, print a row a kernel, fail where a program is refused."""
    parser = plain_parser(__doc__)
    parser.add_argument("sources", nargs="*", metavar="SOURCE", help="kernel files, as refit/blocks.cl (default: all)")
    parser.add_argument("--targets", nargs="+", choices=[APPLE, *AMD, *INTEL], metavar="NAME")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="P")
    args = parser.parse_args()
    targets = args.targets or available()
    for missing in [target for target in [APPLE, *AMD, *INTEL] if target not in available()]:
        print(f"no compiler for {missing} is here", file=sys.stderr)
    table = Results(None, args.json).table(
        "offline", "Registers / bytes of scratch / waves a SIMD (AMD), registers spilled (Intel), of the worst program",
        "; ".join(["kernel", "programs||,", *targets]),
    )  # fmt: skip
    failures = 0
    with ThreadPoolExecutor(args.processes) as threads:
        for source in args.sources or gpu_sources():
            worst: dict[str, dict[str, Use]] = {}
            pairs = [(program, target) for target in targets for program in programs(source, target)]
            jobs = [threads.submit(measure, *pair) for pair in pairs]
            for (_, target), job in zip(pairs, jobs, strict=True):
                try:
                    for name, use in job.result().items():
                        there = worst.setdefault(name, {})
                        there[target] = max(there.get(target, use), use)
                except OfflineError as error:
                    failures += 1
                    print(error, file=sys.stderr)
            count = len(programs(source))
            for name, uses in worst.items():
                table.add(f"{source} {name}", count, *(_cell(uses.get(target), target) for target in targets))
    print(f"\n{failures} refused")
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
