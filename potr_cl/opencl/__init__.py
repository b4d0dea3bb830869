"""OpenCL devices: which there are, one opened, its kernels and its memory. Knows nothing of splats."""
