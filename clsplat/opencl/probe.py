"""Build and run one small kernel on the device of two numbers; exit status 0 means that it worked."""

import sys

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
"""


def main(platform: int, device: int) -> None:
    """Double and reverse eight numbers on the device, or raise."""
    chosen = cl.get_platforms()[platform].get_devices()[device]
    context = cl.Context([chosen])
    queue = cl.CommandQueue(context)
    numbers = np.arange(8, dtype=np.float32)
    flags = cl.mem_flags
    source = cl.Buffer(context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=numbers)
    reversed_numbers = cl.Buffer(context, flags.WRITE_ONLY, numbers.nbytes)
    program = cl.Program(context, SOURCE).build(["-cl-std=CL1.2"])
    cl.Kernel(program, "reverse")(queue, (8,), (8,), source, reversed_numbers)
    result = np.empty_like(numbers)
    cl.enqueue_copy(queue, result, reversed_numbers)
    if not np.array_equal(result, 2 * numbers[::-1]):
        raise SystemExit(f"error: the test kernel computed {result.tolist()}")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
