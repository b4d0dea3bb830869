"""What the kernels compute, written out in float64 and plain numpy: slow, exact, and short enough to be read.

Every result of the OpenCL kernels is compared with these, by the tests and by the tools that measure errors:

- :mod:`tests.reference.raster`: projection, spherical harmonics, compositing;
- :mod:`tests.reference.derivatives`: a picture's derivatives with respect to the splats' parameters;
- :mod:`tests.reference.removal`: the effect of removing a splat;
- :mod:`tests.reference.ridge`: the compaction's regressions;
- :mod:`tests.reference.refit`: the linear map of the colours, its least-squares solution;
- :mod:`tests.reference.refit_cases`: the device's re-fit beside that map;
- :mod:`tests.reference.scenes`: small scenes and cameras to compare on;
- :mod:`tests.reference.captures`: scenes as captures make them, with their cameras;
- :mod:`tests.reference.frames`: cameras that are in a scene's frame, and such that are not.

Of all tests, these alone are there for tools too. The two solvers need scipy, which the extra ``test`` brings.
"""
