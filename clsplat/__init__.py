"""3D Gaussian Splatting on any OpenCL device."""

from pathlib import Path

__version__ = "0.1.0"

_HERE = Path(__file__).resolve().parent


def resource_dir(name: str) -> Path:
    """Return the folder `cl_kernels` or `pipelines`: a wheel carries it inside the package, a checkout beside it."""
    for base in (_HERE, _HERE.parent):
        if (base / name).is_dir():
            return base / name
    raise FileNotFoundError(f"{name}/ is missing beside {_HERE}")
