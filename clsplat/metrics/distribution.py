"""The distributions of size, anisotropy and opacity over the Gaussians of a model."""

import numpy as np

from clsplat.formats.splats import inverse_opacities
from clsplat.gaussians.tables import Gaussians

SHARES = (0.05, 0.25, 0.5, 0.75, 0.95)


def distribution(gaussians: Gaussians) -> dict[str, list[float]]:
    """Return quantiles, at SHARES: size (rms scale, scene units), anisotropy (longest by shortest axis), opacity."""
    log_scales = gaussians.get("log_scales").astype(np.float64)
    columns = {
        "size": np.sqrt(np.exp(2 * log_scales).mean(axis=1)),
        "anisotropy": np.exp(log_scales.max(axis=1) - log_scales.min(axis=1)),
        "opacity": 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0]),
    }
    return {name: [float(value) for value in np.quantile(column, SHARES)] for name, column in columns.items()}
