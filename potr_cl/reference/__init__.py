"""What the kernels compute, written out in float64 and plain numpy: slow, exact, and short enough to be read.

Every result of the OpenCL kernels is compared with these, by the tests and by the tools that measure errors:

- :mod:`potr_cl.reference.raster`: projection, spherical harmonics, compositing;
- :mod:`potr_cl.reference.derivatives`: a picture's derivatives with respect to the splats' parameters;
- :mod:`potr_cl.reference.removal`: the effect of removing a splat;
- :mod:`potr_cl.reference.ridge`: the compaction's regressions;
- :mod:`potr_cl.reference.refit`: the linear map of the colours, its least-squares solution;
- :mod:`potr_cl.reference.refit_cases`: the device's re-fit beside that map;
- :mod:`potr_cl.reference.scenes`: small scenes and cameras to compare on;
- :mod:`potr_cl.reference.captures`: scenes as captures make them, with their cameras;
- :mod:`potr_cl.reference.frames`: cameras that are in a scene's frame, and such that are not.

Nothing else in the package imports them. The two solvers need scipy, which the extra ``test`` brings.
"""
