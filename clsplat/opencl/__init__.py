"""OpenCL devices, programs, and kernel caches; no other package imports pyopencl."""
