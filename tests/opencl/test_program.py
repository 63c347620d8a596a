"""Custom kernel files: missing files and kernels are refused with the expected form."""

import sqlite3
from pickle import UnpicklingError

import pyopencl as cl
import pytest

from clsplat.core.errors import KernelError
from clsplat.opencl.device import Program
from tests.support.devices import on_one_setting


def test_missing_kernel_file_is_named(device, tmp_path):
    with pytest.raises(KernelError, match=r"own\.cl: no such kernel file"):
        device.program(tmp_path / "own.cl")


def test_kernel_without_a_group_size_is_refused_with_the_form(device, tmp_path):
    file = tmp_path / "own.cl"
    file.write_text("kernel void fade(global float *x) { x[0] = 1; }\n")
    with pytest.raises(
        KernelError, match=r"own\.cl: cannot parse the declaration of fade; expected .*reqd_work_group_size"
    ):
        device.program(file)


@on_one_setting
@pytest.mark.parametrize(
    "fault",
    [
        cl.LogicError("clCreateKernel failed: INVALID_KERNEL_NAME"),
        sqlite3.DatabaseError("file is not a database"),
        UnpicklingError("pickle data was truncated"),
    ],
)
def test_program_without_its_kernels_may_be_a_damaged_cache(device, tmp_path, monkeypatch, fault):
    def none(program, name):
        raise fault

    file = tmp_path / "own.cl"
    file.write_text(
        "__kernel __attribute__((reqd_work_group_size(1, 1, 1)))\nvoid own(__global float *restrict x) {}\n"
    )
    monkeypatch.setattr(cl, "Kernel", none)
    with pytest.raises(KernelError, match=rf"{fault}.* may be damaged: remove .*pyopencl, .*pytools and "):
        device.program(file)


def test_build_warning_fails_only_tests(device, tmp_path, monkeypatch):
    file = tmp_path / "own.cl"
    file.write_text(
        "int nothing(void) { }\n"  # `#warning` is an error to NVIDIA's compiler
        "__kernel __attribute__((reqd_work_group_size(1, 1, 1)))\nvoid own(__global float *restrict x) { x[0] = 1; }\n"
    )
    with pytest.raises(KernelError, match="non-void function"):
        device.program(file)
    monkeypatch.setattr(Program, "options", Program.options[:-1])
    assert device.program(file).kernels
