"""OpenUSD as text: a prim ParticleField3DGaussianSplat (UsdVol from 26.03 on), which is written only.

Axes are x right, y up, z back; scales are linear, opacities in [0, 1], quaternions w x y z; the coefficients of a
Gaussian stand together, band 0 first.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.output import Output, written
from clsplat.formats.splats import SplatFile, Writing, flipped, opacities, require_some, unit

BLOCK = 4096  # rows of text at a time
EXTENT = 3.0  # standard deviations around the means
START = """#usda 1.0
(
    defaultPrim = "Gaussians"
    metersPerUnit = 1
    upAxis = "Y"
)

def ParticleField3DGaussianSplat "Gaussians"
{
    uniform token projectionModeHint = "perspective"
    uniform token sortingModeHint = "zDepth"
"""


def write_usda(path: Path, splats: SplatFile, options: Writing) -> str:
    """Write a `.usda` file.  Raises OutputError."""
    require_some(path, splats)
    p = flipped(splats.parameters)
    scales = np.exp(np.clip(p["log_scales"].astype(np.float64), -80, 80))
    around = EXTENT * scales.max(axis=1, keepdims=True)
    extent = np.stack([(p["means"] - around).min(axis=0), (p["means"] + around).max(axis=0)])
    harmonics = np.concatenate([p["sh_base"], p["sh_rest"]], axis=1).reshape(-1, 3)
    tables = {
        "float3[] extent": extent,
        "point3f[] positions": p["means"],
        "quatf[] orientations": unit(p["quats"]),
        "float3[] scales": scales,
        "float[] opacities": opacities(p["logit_opacity"]),
        "float3[] radiance:sphericalHarmonicsCoefficients": harmonics,
    }
    with written(path) as file:
        file.write(START.encode())
        file.write(f"    uniform int radiance:sphericalHarmonicsDegree = {splats.sh_degree}\n".encode())
        for name, table in tables.items():
            _array(file, name, table)
        file.write(b"}\n")
    return file.sha256


def _array(file: Output, name: str, table: NDArray[np.floating]) -> None:
    """One attribute, with as many digits as float32 has."""
    width = table.shape[1]
    row = ", ".join(["%.9g"] * width) if width == 1 else f"({', '.join(['%.9g'] * width)})"
    file.write(f"    {name} = [".encode())
    for start in range(0, len(table), BLOCK):
        block = table[start : start + BLOCK].astype(np.float32)
        text = ", ".join([row] * len(block)) % tuple(block.ravel().tolist())
        file.write((", " if start else "").encode() + text.encode())
    file.write(b"]\n")
