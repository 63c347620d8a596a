"""Build and run two small kernels on a device, given by its platform and device index; exit code 0 means success.

Without arguments, load all runtimes and query their devices.
"""

import os
import sys
from contextlib import suppress

from clsplat.opencl import runtimes

runtimes.prepare()

import numpy as np  # noqa: E402
import pyopencl as cl  # noqa: E402

SOURCE = """
__kernel __attribute__((reqd_work_group_size(8, 1, 1)))
void reverse(__global const float *restrict from, __global float *restrict to)
{
    __local float part[8];
    part[get_local_id(0)] = 2.0f * from[get_global_id(0)];
    barrier(CLK_LOCAL_MEM_FENCE);
    to[get_global_id(0)] = part[7 - get_local_id(0)];
}

// A runtime that does not know the processor lacks square roots and conversions of vectors.
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void vector_root(__global float *restrict squares)
{
    vstore%(lanes)d(convert_float%(lanes)d(convert_int%(lanes)d(sqrt(vload%(lanes)d(0, squares)))), 0, squares);
}
"""

# Part of a clang warning: kernels are compiled without the vectors that the device reports, unlike the runtime's
# library.  This happens with PoCL 3.0 on newer processors, where its compiler may also run for minutes.
VECTOR_WARNING = "changes the ABI"


def main(platform: int, device: int) -> None:
    """Double and reverse eight numbers on the device, and take the square roots of a vector.

    Raises SystemExit if a result is wrong.
    """
    cl_device = cl.get_platforms()[platform].get_devices()[device]
    context = cl.Context([cl_device])
    queue = cl.CommandQueue(context)
    values = np.arange(8, dtype=np.float32)
    flags = cl.mem_flags
    source = cl.Buffer(context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=values)
    reversed_values = cl.Buffer(context, flags.WRITE_ONLY, values.nbytes)
    lanes = 16 if cl_device.native_vector_width_float >= 16 else 8 if cl_device.native_vector_width_float >= 8 else 4
    program = cl.Program(context, SOURCE % {"lanes": lanes}).build(["-cl-std=CL1.2"])
    if VECTOR_WARNING in program.get_build_info(cl_device, cl.program_build_info.LOG):
        raise SystemExit("error: kernels are compiled without the processor's vector instructions")
    cl.Kernel(program, "reverse")(queue, (8,), (8,), source, reversed_values)
    result = np.empty_like(values)
    cl.enqueue_copy(queue, result, reversed_values)
    if not np.array_equal(result, 2 * values[::-1]):
        raise SystemExit(f"error: the test kernel computed {result.tolist()}")
    values = np.arange(lanes, dtype=np.float32)
    squares = cl.Buffer(context, flags.READ_WRITE | flags.COPY_HOST_PTR, hostbuf=values**2)
    cl.Kernel(program, "vector_root")(queue, (1,), (1,), squares)
    roots = np.empty_like(values)
    cl.enqueue_copy(queue, roots, squares)
    if not np.array_equal(roots, values):
        raise SystemExit(f"error: the test kernel computed square roots {roots.tolist()}")


def load_runtimes() -> None:
    """Query all devices, and print a line before and after."""
    print(runtimes.LOADING, flush=True)
    with suppress(cl.Error):
        for platform in cl.get_platforms():
            with suppress(cl.Error):
                for device in platform.get_devices():
                    _ = platform.version, device.name, device.driver_version, device.native_vector_width_float
    print(f"\n{runtimes.LOADED}", flush=True)


if __name__ == "__main__":
    if not sys.argv[1:]:
        load_runtimes()
        sys.exit()
    try:
        main(int(sys.argv[1]), int(sys.argv[2]))
    except cl.Error as error:
        print(f"error: a test kernel fails ({error})", file=sys.stderr, flush=True)
        os._exit(1)  # a runtime whose compiler failed may hang when it is closed
