"""Kernel files of one's own: what cannot be read or found is refused with the form that is expected."""

import pytest

from clsplat.errors import KernelError


def test_a_missing_kernel_file_is_named(device, tmp_path):
    with pytest.raises(KernelError, match=r"own\.cl: no such kernel file"):
        device.program(tmp_path / "own.cl")


def test_a_kernel_without_a_group_size_is_refused_with_the_form_expected(device, tmp_path):
    file = tmp_path / "own.cl"
    file.write_text("kernel void fade(global float *x) { x[0] = 1; }\n")
    with pytest.raises(KernelError, match=r"own\.cl: cannot read the head of fade; expected .*reqd_work_group_size"):
        device.program(file)
