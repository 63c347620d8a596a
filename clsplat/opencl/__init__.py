"""OpenCL devices, their programs and their caches; nothing else imports pyopencl."""
