"""An oracle of rendering and its gradients in float64 that shares no code with the project's reference.

It projects every Gaussian with complex numbers, so that a step of 1e-200 i gives exact derivatives (Squire and Trapp
1998), and blends over all pixels at once.  `python -m tests.conformance.oracle` prints the errors of the device for all
kinds of scenes.
"""

import sys
from dataclasses import dataclass
from math import pi
from math import sqrt as root
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[Any]
Tables = dict[str, Values]  # by name, [N, components]
STEP = 1e-200
ALPHA_MIN, ALPHA_MAX, T_MIN = 1 / 255, 0.99, 1e-4  # Kerbl et al. 2023
FILTERS = {"dilation": (0.3, False), "ewa": (0.3, True), "mip": (0.1, True)}  # variance px², keeps the energy
TABLES = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3, "sh_rest": 45}
BACKGROUND = np.array([0.3, 0.6, 0.1])


@dataclass(frozen=True)
class Pinhole:
    """A camera; sizes, focal lengths, and principal point in px."""

    pose: Values  # [3, 4] world to camera
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float = 0.2


@dataclass(frozen=True)
class Splats:
    """Projected Gaussians; complex where a parameter was moved."""

    mean: Values  # [N, 2] px
    covariance: Values  # [N, 3] xx, xy, yy, px²
    opacity: Values  # [N]
    color: Values  # [N, 3]
    depth: Values  # [N]
    is_visible: NDArray[np.bool_]  # [N]

    def columns(self) -> Values:
        """Return what pixels depend on, [N, 9]."""
        return np.column_stack([self.mean, self.covariance, self.opacity, self.color])


def harmonics(direction: Values) -> Values:
    """Return the 16 real spherical harmonics by their Cartesian polynomials with the signs of 3DGS, [N, 16]."""
    x, y, z = direction.T
    return np.stack(
        [
            0 * x + root(1 / (4 * pi)),
            -root(3 / (4 * pi)) * y,
            root(3 / (4 * pi)) * z,
            -root(3 / (4 * pi)) * x,
            root(15 / (4 * pi)) * x * y,
            -root(15 / (4 * pi)) * y * z,
            root(5 / (16 * pi)) * (2 * z * z - x * x - y * y),
            -root(15 / (4 * pi)) * x * z,
            root(15 / (16 * pi)) * (x * x - y * y),
            -root(35 / (32 * pi)) * y * (3 * x * x - y * y),
            root(105 / (4 * pi)) * x * y * z,
            -root(21 / (32 * pi)) * y * (4 * z * z - x * x - y * y),
            root(7 / (16 * pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -root(21 / (32 * pi)) * x * (4 * z * z - x * x - y * y),
            root(105 / (16 * pi)) * z * (x * x - y * y),
            -root(35 / (32 * pi)) * x * (x * x - 3 * y * y),
        ],
        axis=1,
    )


def rotate(quat: Values) -> Values:
    """Return the rotation matrices of unit quaternions, [4, …] -> [3, 3, …]."""
    w, i, j, k = quat
    return np.stack(
        [
            np.stack([w * w + i * i - j * j - k * k, 2 * (i * j - w * k), 2 * (i * k + w * j)]),
            np.stack([2 * (i * j + w * k), w * w - i * i + j * j - k * k, 2 * (j * k - w * i)]),
            np.stack([2 * (i * k - w * j), 2 * (j * k + w * i), w * w - i * i - j * j + k * k]),
        ]
    )


def limit(value: Values, low: float, high: float) -> Values:
    """Clip by the real part; the derivative is 0 where a value is clipped."""
    return np.where(value.real < low, low, np.where(value.real > high, high, value))


def project(tables: Tables, camera: Pinhole, screen_filter: str) -> Splats:
    """Project Gaussians with EWA splatting (Zwicker et al. 2001), as 3DGS does."""
    variance, keeps_energy = FILTERS[screen_filter]
    rotation, translation = camera.pose[:, :3], camera.pose[:, 3]
    x, y, z = (tables["means"] @ rotation.T + translation).T
    quat = tables["quats"] / np.sqrt((tables["quats"] ** 2).sum(axis=1, keepdims=True))
    axes = rotate(quat.T)  # its columns are the axes of the Gaussians
    half_x, half_y = camera.width / camera.fx / 2, camera.height / camera.fy / 2
    tx = limit(x / z, -camera.cx / camera.fx - 0.3 * half_x, (camera.width - camera.cx) / camera.fx + 0.3 * half_x)
    ty = limit(y / z, -camera.cy / camera.fy - 0.3 * half_y, (camera.height - camera.cy) / camera.fy + 0.3 * half_y)
    in_camera = np.einsum("ab,bcn->acn", rotation, axes) * np.exp(tables["log_scales"]).T[None]
    row_x = camera.fx / z * (in_camera[0] - tx * in_camera[2])  # [3, N]
    row_y = camera.fy / z * (in_camera[1] - ty * in_camera[2])
    xx, xy, yy = (row_x * row_x).sum(axis=0), (row_x * row_y).sum(axis=0), (row_y * row_y).sum(axis=0)
    sharp = sum((row_x[a] * row_y[b] - row_x[b] * row_y[a]) ** 2 for a, b in ((0, 1), (0, 2), (1, 2)))
    determinant = sharp + variance * (xx + yy) + variance**2
    opacity = 1 / (1 + np.exp(-tables["logit_opacity"][:, 0]))
    if keeps_energy:
        opacity = opacity * np.sqrt(sharp / determinant)
    offset = tables["means"] + rotation.T @ translation
    basis = harmonics(offset / np.sqrt((offset**2).sum(axis=1, keepdims=True)))
    coefficients = np.column_stack([tables["sh_base"], tables["sh_rest"]]).reshape(-1, 16, 3)
    color = 0.5 + np.einsum("nk,nkc->nc", basis, coefficients)
    return Splats(
        mean=np.column_stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]),
        covariance=np.column_stack([xx + variance, xy, yy + variance]),
        opacity=opacity,
        color=np.where(color.real > 0, color, 0),
        depth=z,
        is_visible=(z.real >= camera.near) & (opacity.real > ALPHA_MIN),
    )


@dataclass(frozen=True)
class Picture:
    """A rendered view, and the gradient of a loss by what the pixels depend on."""

    image: Values  # [H, W, 3]
    alpha: Values  # [H, W]
    depth: Values  # [H, W] mean depth
    gradient: Values  # [N, 9], of `Splats.columns`


def blend(splats: Splats, camera: Pinhole, grad_image: Values, grad_alpha: Values) -> Picture:
    """Blend splats front to back over all pixels, with the gradient.  grad_image: [H, W, 3]; grad_alpha: [H, W]."""
    pixel_x, pixel_y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    order = np.argsort(splats.depth.real, kind="stable")
    order = order[splats.is_visible[order]]
    passed, is_running = np.ones(pixel_x.shape), np.ones(pixel_x.shape, bool)
    layers = []
    for n in order:
        xx, xy, yy = splats.covariance[n].real
        dx, dy = pixel_x - splats.mean[n, 0].real, pixel_y - splats.mean[n, 1].real
        falloff = np.exp(-(yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy) / 2)
        alpha = np.minimum(ALPHA_MAX, splats.opacity[n].real * falloff)
        is_drawn = is_running & (alpha >= ALPHA_MIN)
        is_last = is_drawn & (passed * (1 - alpha) < T_MIN)
        is_running &= ~is_last
        alpha = np.where(is_drawn & ~is_last, alpha, 0)
        layers.append((n, dx, dy, falloff, alpha, passed))
        passed = passed * (1 - alpha)
    image, depth = passed[..., None] * BACKGROUND, 0 * passed
    behind = (image * grad_image).sum(axis=-1) - passed * grad_alpha  # of the loss, by what is behind a splat
    gradient = np.zeros((len(splats.depth), 9))
    for n, dx, dy, falloff, alpha, before in reversed(layers):
        color, weight = splats.color[n].real, alpha * before
        image = image + weight[..., None] * color
        depth = depth + weight * splats.depth[n].real
        by_color = (grad_image * color).sum(axis=-1)
        by_alpha = np.where((alpha > 0) & (alpha < ALPHA_MAX), before * by_color - behind / (1 - alpha), 0)
        behind = behind + weight * by_color
        by_falloff = by_alpha * splats.opacity[n].real * falloff
        xx, xy, yy = splats.covariance[n].real
        inverse = np.array([[yy, -xy], [-xy, xx]]) / (xx * yy - xy * xy)
        u, v = inverse[0, 0] * dx + inverse[0, 1] * dy, inverse[0, 1] * dx + inverse[1, 1] * dy
        gradient[n] = [
            (by_falloff * u).sum(),
            (by_falloff * v).sum(),
            (by_falloff * u * u).sum() / 2,
            (by_falloff * u * v).sum(),
            (by_falloff * v * v).sum() / 2,
            (by_alpha * falloff).sum(),
            *(weight[..., None] * grad_image).sum(axis=(0, 1)),
        ]
    return Picture(image, 1 - passed, depth / np.maximum(1 - passed, 1e-30), gradient)


def render(
    tables: Tables, camera: Pinhole, screen_filter: str, grad_image: Values, grad_alpha: Values
) -> tuple[Picture, Tables]:
    """Return a picture, and the gradients of Σ grad_image·image + Σ grad_alpha·alpha by all tables."""
    picture = blend(project(tables, camera, screen_filter), camera, grad_image, grad_alpha)
    gradients = {}
    for name, table in tables.items():
        gradients[name] = np.empty(table.shape)
        for column in range(table.shape[1]):
            moved = table.astype(complex)
            moved[:, column] += STEP * 1j
            columns = project({**tables, name: moved}, camera, screen_filter).columns()
            gradients[name][:, column] = (picture.gradient * columns.imag / STEP).sum(axis=1)
    return picture, gradients


# Kinds of scenes.


@dataclass(frozen=True)
class Kind:
    """A kind of scene: the sizes of splats on the screen, and the camera."""

    sizes: tuple[float, float, float] = (2.0, 4.0, 3.0)  # standard deviations along the axes, px
    aspect: float = 0.0  # of filtered splats on the screen; 0: by `sizes`
    opacity: tuple[float, float] = (-1.0, 2.0)  # range of logits
    depth: tuple[float, float] = (2.0, 4.0)
    focal: tuple[float, float] = (60.0, 60.0)
    center: tuple[float, float] = (32.0, 24.0)
    spread: float = 0.4  # of the field of view
    count: int = 12


KINDS = {
    "compact": Kind(),
    "off-center": Kind(focal=(70.0, 50.0), center=(20.0, 30.0)),
    "small": Kind(sizes=(0.2, 0.3, 0.1), opacity=(1.0, 3.0), count=30),
    "large": Kind(sizes=(30.0, 60.0, 40.0), opacity=(-3.0, 0.0)),
    "discs": Kind(sizes=(6.0, 5.0, 0.01)),
    "faint": Kind(opacity=(-5.4, -4.0)),
    "opaque": Kind(opacity=(4.0, 9.0), sizes=(6.0, 8.0, 7.0), count=20),
    "near": Kind(depth=(0.15, 0.4), sizes=(1.0, 2.0, 1.5)),
    "wide": Kind(focal=(9.0, 9.0), spread=0.9, sizes=(1.0, 2.0, 1.5)),
    "needles 30": Kind(aspect=30.0),
    "needles 70": Kind(aspect=70.0),
    "needles 150": Kind(aspect=150.0),
}


def make_scene(kind: Kind, screen_filter: str, seed: int) -> tuple[Tables, Pinhole]:
    """Return random Gaussians in front of a turned camera, rounded to float32."""
    rng = np.random.default_rng([seed, list(FILTERS).index(screen_filter), kind.count])
    quat = rng.normal(size=4)
    quat /= np.linalg.norm(quat)
    turn = rotate(quat)
    camera = Pinhole(np.column_stack([turn, rng.uniform(-1, 1, 3)]), 64, 48, *kind.focal, *kind.center)
    n = kind.count
    z = rng.uniform(*kind.depth, n)
    x = camera.width * (0.5 + kind.spread * rng.uniform(-0.5, 0.5, n))
    y = camera.height * (0.5 + kind.spread * rng.uniform(-0.5, 0.5, n))
    position = np.column_stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z])
    sizes = np.array(kind.sizes)[None] * rng.uniform(0.7, 1.4, (n, 3))
    quats = rng.normal(size=(n, 4))
    if kind.aspect:  # in planes that face the camera, so that the whole length is seen
        width = 0.1
        length = kind.aspect * root(FILTERS[screen_filter][0] + width**2)
        sizes = np.tile([length, width, width], (n, 1))
        (w, i, j, k), angle = quat * [1, -1, -1, -1], rng.uniform(0, pi / 2, n)
        c, d = np.cos(angle), np.sin(angle)
        quats = np.stack([w * c - k * d, i * c + j * d, j * c - i * d, k * c + w * d], axis=1)
    tables = {
        "means": (position - camera.pose[:, 3]) @ turn,
        "quats": quats * rng.uniform(0.5, 2, (n, 1)),
        "log_scales": np.log(sizes * z[:, None] / min(kind.focal)),
        "logit_opacity": rng.uniform(*kind.opacity, (n, 1)),
        "sh_base": rng.normal(0, 0.8, (n, 3)),
        "sh_rest": rng.normal(0, 0.1, (n, 45)),
    }
    return {name: table.astype(np.float32).astype(np.float64) for name, table in tables.items()}, camera


def errors(device: Any, kind: str, screen_filter: str, seed: int) -> dict[str, tuple[float, float]]:
    """Return the median and the largest error of the device's image, alpha, depth, and gradients.

    Gradients are relative to the largest entry of their table, depth to the largest depth.
    """
    from clsplat import Camera, Model, Renderer, Rendering, View

    tables, camera = make_scene(KINDS[kind], screen_filter, seed)
    rng = np.random.default_rng(seed)
    grad_image = rng.normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    grad_alpha = rng.normal(size=(camera.height, camera.width)).astype(np.float32)
    variance, keeps_energy = FILTERS[screen_filter]
    rendering = Rendering(near=camera.near, screen_variance=variance, compensate=float(keeps_energy))
    lens = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    renderer = Renderer(Model(**tables, rendering=rendering), device)
    result = renderer.render(View("oracle", lens, camera.pose), tuple(BACKGROUND), depth=True)
    actual = result.backward(grad_image, grad_alpha)
    picture, gradients = render(tables, camera, screen_filter, grad_image, grad_alpha)
    differences = {
        "image": result.image - picture.image,
        "alpha": result.alpha - picture.alpha,
        "depth": (result.depth - picture.depth) / picture.depth.max(),
        **{name: (getattr(actual, name) - table) / np.abs(table).max() for name, table in gradients.items()},
    }
    return {name: (float(np.median(abs(e))), float(abs(e).max())) for name, e in differences.items()}


if __name__ == "__main__":
    device = sys.argv[1] if len(sys.argv) > 1 else None
    for kind in KINDS:
        for screen_filter in FILTERS:
            runs = [errors(device, kind, screen_filter, seed) for seed in (0, 1)]
            worst = {name: tuple(max(run[name][i] for run in runs) for i in (0, 1)) for name in runs[0]}
            print(kind, screen_filter, *(f"{name} {m:.0e}/{w:.0e}" for name, (m, w) in worst.items()), sep="  ")
