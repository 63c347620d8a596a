"""Every kernel has a test: after all others, what they launched is held against the kernels that there are."""

from clsplat import resource_dir
from clsplat.opencl.program import parse_kernels


def test_every_kernel_was_launched(launched):
    """With each schedule, but for those that are written for one of them."""
    for schedule, other in (("wide", "simt"), ("simt", "wide")):
        kernels = {
            f"{path.name}:{name}"
            for path in resource_dir("cl_kernels").glob("*.cl")
            if not path.stem.endswith(other)
            for name in parse_kernels(path.read_text())
        }
        found = {label for one, label in launched if one == schedule}
        assert not kernels - found, f"no kernel test launches {', '.join(sorted(kernels - found))}"
        assert found == kernels
