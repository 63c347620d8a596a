"""The reference, against finite differences, closed forms, and hand-computed values."""

from dataclasses import replace

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from clsplat.conformance import reference as ref
from tests.support.devices import each_once
from tests.support.oracle import BACKGROUND, HEIGHT, WIDTH, general_camera, random_gaussians, render_backward, to_world

STEP = 1e-4  # of the five-point differences below, whose error goes like STEP⁴
FD_TOLERANCE = 1e-6
FEW = 3  # Gaussians: a chain is rendered four times for each of their numbers


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def simple_camera(width: int = WIDTH, height: int = HEIGHT, focal: float = 40.0) -> ref.PinholeCamera:
    """At the origin, looking along z, principal point in the middle."""
    return ref.PinholeCamera(np.eye(3, 4), focal, focal, width / 2, height / 2, width, height)


def isotropic(mean: list[float], scale: float, opacity: float, color: list[float]) -> ref.RawGaussians:
    """One round Gaussian of constant color."""
    return ref.RawGaussians(
        means=[mean],
        quats=[[1, 0, 0, 0]],
        log_scales=[[np.log(scale)] * 3],
        logit_opacity=[np.log(opacity / (1 - opacity))],
        sh=[[(np.array(color) - 0.5) / 0.28209479177387814]],
    )


def flat_splats(depth: list[float], opacity: list[float], color: list[list[float]]) -> ref.Splats:
    """Splats so wide that alpha is the opacity everywhere."""
    count = len(depth)
    return ref.Splats(
        mean2d=np.zeros((count, 2)),
        conic=np.zeros((count, 3)),
        opacity=np.array(opacity),
        color=np.array(color, np.float64),
        depth=np.array(depth, np.float64),
        radius=np.ones(count),
        visible=np.ones(count, bool),
    )


def five_point(function, array: np.ndarray) -> np.ndarray:
    """Numerical gradient of `function()` with respect to `array`, which is changed in place and restored."""
    grad = np.zeros(array.shape)
    for at in np.ndindex(array.shape):
        original = array[at]
        values = []
        for offset in (-2, -1, 1, 2):
            array[at] = original + offset * STEP
            values.append(function())
        array[at] = original
        grad[at] = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * STEP)
    return grad


def relative_error(analytic: np.ndarray, numeric: np.ndarray) -> float:
    """Worst element; elements a thousand times smaller than the largest are measured against that size."""
    floor = 1e-3 * np.max(np.abs(numeric))
    return float(np.max(np.abs(analytic - numeric) / np.maximum(np.abs(numeric), floor)))


def check_gradients(analytic: dict[str, np.ndarray], holder: object, function) -> dict[str, float]:
    """Compare every gradient with differences in the attribute of the same name; return the worst relative errors."""
    errors = {}
    for name, grad in analytic.items():
        numeric = five_point(function, getattr(holder, name))
        assert np.any(numeric != 0), f"{name} has no influence: the test tests nothing"
        errors[name] = relative_error(grad, numeric)
    message = "worst relative errors: " + ", ".join(f"{name} {error:.1e}" for name, error in errors.items())
    print(message)
    assert max(errors.values()) <= FD_TOLERANCE, message
    return errors


def check_chain(
    rng, gaussians: ref.RawGaussians, camera: ref.PinholeCamera, degree: int, **screen
) -> dict[str, np.ndarray]:
    """Finite differences of parameters -> image -> weighted sum, with all thresholds off."""
    weights = rng.normal(0, 1, (3, camera.height, camera.width))

    def value() -> float:
        return np.sum(
            weights
            * ref.render(gaussians, camera, BACKGROUND, degree, thresholds=ref.SMOOTH_THRESHOLDS, **screen).image
        )

    splats = ref.project(gaussians, camera, degree, thresholds=ref.SMOOTH_THRESHOLDS, **screen)
    assert splats.visible.all()
    analytic, _ = render_backward(
        gaussians, camera, BACKGROUND, degree, splats, weights, thresholds=ref.SMOOTH_THRESHOLDS, **screen
    )
    check_gradients(analytic, gaussians, value)
    return analytic


# ---- The whole chain against finite differences -------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_chain_vanilla(rng, degree):
    camera = general_camera()
    grad = check_chain(rng, random_gaussians(rng, camera, degree, FEW), camera, degree)
    used = (degree + 1) ** 2
    assert np.all(grad["sh"][:, :used] != 0)
    assert np.all(grad["sh"][:, used:] == 0)


def test_chain_compensated(rng):
    camera = general_camera()
    check_chain(rng, random_gaussians(rng, camera, 1, FEW), camera, 1, variance=0.3, compensate=1.0)


def test_chain_mip(rng):
    camera = general_camera()
    gaussians = random_gaussians(rng, camera, 1)
    gaussians.log_scales -= 1  # thin ones, so that both filters matter
    gaussians.filter_variance = rng.uniform(0.01, 0.1, len(gaussians.means))
    splats = ref.project(gaussians, camera, 1, variance=0.1, compensate=1.0, thresholds=ref.SMOOTH_THRESHOLDS)
    raw = 1 / (1 + np.exp(-gaussians.logit_opacity))
    assert np.all(splats.opacity < 0.9 * raw)
    check_chain(rng, gaussians, camera, 1, variance=0.1, compensate=1.0)


def test_chain_of_a_step_with_dropout(rng):
    """A constant factor of the opacities changes the gradients as it should."""
    camera = general_camera()
    gaussians = random_gaussians(rng, camera, 1, FEW)
    plain = ref.project(gaussians, camera, 1).opacity
    gaussians.opacity_factor = 1.25
    np.testing.assert_allclose(ref.project(gaussians, camera, 1).opacity, 1.25 * plain)
    check_chain(rng, gaussians, camera, 1, compensate=1.0)


@pytest.mark.parametrize("side", [(1.25, 0.1), (-1.0, 0.1), (0.1, 1.0), (0.1, -0.9), (1.3, 1.0)])
def test_chain_clamped_ray(rng, side):
    """Far outside the frustum, but wide enough to reach the image: J uses the clamped ray."""
    camera = general_camera()
    gaussians = random_gaussians(rng, camera, 1, FEW)
    point = np.array([side[0] * 3, side[1] * 3, 3.0])
    gaussians.means[0] = to_world(camera, point)
    gaussians.log_scales[0] = np.log([1.2, 1.5, 0.9])
    gaussians.logit_opacity[0] = 2
    assert np.any(ref.clamped_ray(camera, point) != point[:2])
    frame = ref.render(gaussians, camera, BACKGROUND, 1)
    without = replace(gaussians, logit_opacity=gaussians.logit_opacity - [100, 0, 0])
    assert np.max(np.abs(frame.image - ref.render(without, camera, BACKGROUND, 1).image)) > 0.05
    check_chain(rng, gaussians, camera, 1)


def test_chain_clamped_color(rng):
    """A channel below zero is black and has no gradient; the others keep theirs."""
    camera = general_camera()
    gaussians = random_gaussians(rng, camera, 1, FEW)
    gaussians.sh[1, 0, 2] = -6
    assert ref.project(gaussians, camera, 1).color[1, 2] == 0
    grad = check_chain(rng, gaussians, camera, 1)
    assert np.all(grad["sh"][1, :4, 2] == 0)
    assert np.all(grad["sh"][1, :4, :2] != 0)


def test_chain_with_capped_alpha(rng):
    """Where alpha is capped the derivative is zero; passing the gradient through would fail."""
    camera = general_camera()
    gaussians = random_gaussians(rng, camera, 1, FEW)
    gaussians.logit_opacity[2] = 6
    gaussians.log_scales[2] = np.log([0.8, 0.9, 0.7])  # wide: several pixels above the cap
    splats = ref.project(gaussians, camera, 1)
    assert any(np.any(step.alpha == 0.99) for step in ref.blend_steps(splats, WIDTH, HEIGHT, ref.SMOOTH_THRESHOLDS))
    assert ref.margin(splats, WIDTH, HEIGHT, ref.SMOOTH_THRESHOLDS).cap > 10 * STEP, "a pixel would cross the cap"
    check_chain(rng, gaussians, camera, 1)


# ---- Stages on their own ------------------------------------------------------------------------------------------


def test_blend_gradients(rng):
    """With the usual thresholds, on a scene whose pixels do not cross them."""
    camera = general_camera()
    splats = ref.project(random_gaussians(rng, camera, 0), camera, 0)
    thresholds = ref.Thresholds(transmittance_min=0.2)  # high, so that some pixels stop
    safe, stopped, faint = np.ones((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH), bool), 0
    for step in ref.blend_steps(splats, WIDTH, HEIGHT, thresholds):
        near_alpha_min = np.abs(step.alpha / thresholds.alpha_min - 1) < 0.3
        near_stop = np.abs(step.transmittance * (1 - step.alpha) / thresholds.transmittance_min - 1) < 0.3
        safe &= ~(step.is_active & (near_alpha_min | near_stop))
        stopped |= step.is_candidate & ~step.is_blended
        faint += step.is_active & ~step.is_candidate
    assert np.sum(safe & stopped) > 10
    assert np.sum(safe & (faint > 0)) > 10
    weights = rng.normal(0, 1, (3, HEIGHT, WIDTH)) * safe

    def value() -> float:
        return np.sum(weights * ref.blend(splats, WIDTH, HEIGHT, BACKGROUND, thresholds)[0])

    grad = ref.blend_backward(splats, WIDTH, HEIGHT, BACKGROUND, weights, thresholds)._asdict()
    del grad["mean2d_abs"]
    check_gradients(grad, splats, value)


def test_absolute_mean2d_gradient(rng):
    """The sum over pixels of the absolute gradient of one pixel at a time."""
    width, height = 9, 7
    camera = simple_camera(width, height, 12.0)
    splats = ref.project(random_gaussians(rng, camera, 0), camera, 0)
    weights = rng.normal(0, 1, (3, height, width))
    total = np.zeros_like(splats.mean2d)
    for row, column in np.ndindex(height, width):
        single = np.zeros_like(weights)
        single[:, row, column] = weights[:, row, column]
        total += np.abs(ref.blend_backward(splats, width, height, BACKGROUND, single).mean2d)
    grad = ref.blend_backward(splats, width, height, BACKGROUND, weights)
    np.testing.assert_allclose(grad.mean2d_abs, total, rtol=1e-12)
    assert np.all(grad.mean2d_abs > 1.01 * np.abs(grad.mean2d))


def test_compensation_gradient_is_the_stable_form_of_8_2(rng):
    """d(det V / det V1)/dV is (1-κ²) K - k det(K) I."""
    camera = general_camera()
    foot = ref.project_covariance(random_gaussians(rng, camera, 0), 0, camera, 0.1)
    conic = np.linalg.inv(foot.filtered_cov2d)
    ratio = np.linalg.det(foot.cov2d) / np.linalg.det(foot.filtered_cov2d)
    stable = (1 - ratio) * conic - 0.1 * np.linalg.det(conic) * np.eye(2)
    np.testing.assert_allclose(ref.ratio_gradient(foot), stable, rtol=1e-10)


def test_harmonics_are_orthonormal():
    """Gauss-Legendre in cos θ times equal steps in φ integrates their products exactly."""
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * np.pi / 16
    z, azimuth = np.meshgrid(nodes, phi, indexing="ij")
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=-1)
    weights = node_weights[:, None] * np.full(16, 2 * np.pi / 16)
    basis = ref.sh_basis(directions, 3)
    gram = np.einsum("ij,ijk,ijl->kl", weights, basis, basis)
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-14)


def test_harmonics_match_values_computed_by_hand():
    """Orthonormality does not determine signs and order, so compare with hand-computed values for one direction."""
    basis = ref.sh_basis(np.array([2.0, 3.0, 6.0]) / 7, 3)
    # Numerators over 7^l: -y, z, -x | xy, -yz, 2z²-x²-y², -xz, x²-y² | -y(3x²-y²), xyz, ...
    numerators = [1, -3, 6, -2, 6, -18, 59, -12, -5, -9, 36, -393, 198, -262, -30, 46]
    degrees = np.repeat([0, 1, 2, 3], [1, 3, 5, 7])
    r1, r2, r3 = np.sqrt(1 / np.pi), np.sqrt(15 / np.pi), np.sqrt(35 / np.pi)
    constants = [r1 / 2, *[np.sqrt(3 / np.pi) / 2] * 3]
    constants += [r2 / 2, r2 / 2, np.sqrt(5 / np.pi) / 4, r2 / 2, r2 / 4]
    constants += [np.sqrt(35 / (2 * np.pi)) / 4, np.sqrt(105 / np.pi) / 2, np.sqrt(21 / (2 * np.pi)) / 4]
    constants += [np.sqrt(7 / np.pi) / 4, np.sqrt(21 / (2 * np.pi)) / 4, np.sqrt(105 / np.pi) / 4, r3 / np.sqrt(2) / 4]
    np.testing.assert_allclose(basis, np.array(constants) * numerators / 7.0**degrees, rtol=1e-14)


def test_harmonics_gradient(rng):
    directions = rng.normal(0, 1, (5, 3))
    numeric = np.stack(
        [
            five_point(lambda at=at, k=k: ref.sh_basis(directions[at], 3)[k], directions[at])
            for at in range(5)
            for k in range(16)
        ]
    ).reshape(5, 16, 3)
    np.testing.assert_allclose(ref.sh_basis_gradient(directions, 3), numeric, atol=1e-10)


# ---- Closed forms and values by hand ------------------------------------------------------------------------------


def test_isotropic_gaussian_renders_as_a_disc():
    """On the axis the footprint is a disc of variance (f s / z)² + 0.3."""
    scale, depth, opacity, focal = 0.2, 2.5, 0.8, 40.0
    color = np.array([0.9, 0.3, 0.1])
    camera = simple_camera(focal=focal)
    gaussians = isotropic([0, 0, depth], scale, opacity, color)
    frame = ref.render(gaussians, camera, BACKGROUND, 0, thresholds=ref.SMOOTH_THRESHOLDS)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    alpha = opacity * np.exp(-0.5 * (x**2 + y**2) / ((focal * scale / depth) ** 2 + 0.3))
    expected = color[:, None, None] * alpha + BACKGROUND[:, None, None] * (1 - alpha)
    np.testing.assert_allclose(frame.image, expected, rtol=1e-13)
    np.testing.assert_allclose(frame.transmittance, 1 - alpha, rtol=1e-13)
    assert np.all(frame.splat_count == 1)


def test_pixel_centers_and_axes():
    """x/z = 0.1 and y/z = -0.2 at f = 40 lie 4 px right of and 8 px above the principal point."""
    splats = ref.project(isotropic([0.3, -0.6, 3], 0.1, 0.5, [1, 1, 1]), simple_camera(), 0)
    np.testing.assert_allclose(splats.mean2d, [[24, 7]], rtol=1e-14)
    np.testing.assert_allclose(splats.depth, [3])
    image, _, _ = ref.blend(splats, WIDTH, HEIGHT, np.zeros(3))
    middle = image[0, 6:8, 23:25]  # the mean is the corner shared by these four pixels
    assert middle.min() > 0.99 * image.max()


def test_jacobian_is_the_derivative_of_the_projection(rng):
    """M = J W inside the limits of the ray; outside, J is that of the point moved to the limit."""
    camera = general_camera()
    gaussians = random_gaussians(rng, camera, 0, count=1)
    numeric = [
        five_point(lambda axis=axis: ref.project(gaussians, camera, 0).mean2d[0, axis], gaussians.means)[0]
        for axis in (0, 1)
    ]
    analytic = ref.project_covariance(gaussians, 0, camera, 0.3).jacobian
    np.testing.assert_allclose(analytic @ camera.rotation, numeric, rtol=1e-8)

    limits = ref.ray_limits(camera)
    beyond, at_limit = [1.0, limits[1, 0] - 1, 1.0], [limits[0, 1], limits[1, 0], 1.0]
    gaussians.means = np.array([to_world(camera, 2 * np.array(point)) for point in (beyond, at_limit)])
    gaussians.quats, gaussians.log_scales = gaussians.quats[[0, 0]], gaussians.log_scales[[0, 0]]
    gaussians.filter_variance = np.zeros(2)
    first, second = (ref.project_covariance(gaussians, n, camera, 0.3).jacobian for n in (0, 1))
    np.testing.assert_allclose(first, second, rtol=1e-12)


def test_limits_of_the_ray():
    """0.3 of half the field of view beyond the image's edges, wherever the principal point is."""
    camera = ref.PinholeCamera(np.eye(3, 4), fx=40, fy=60, cx=10, cy=20, width=40, height=30)
    expected = [[-(10 / 40 + 0.15), 30 / 40 + 0.15], [-(20 / 60 + 0.075), 10 / 60 + 0.075]]
    np.testing.assert_allclose(ref.ray_limits(camera), expected, rtol=1e-14)
    half = 1.3 * np.array([0.5, 0.375])  # the 1.3 tan of the centered camera
    np.testing.assert_allclose(ref.ray_limits(simple_camera()), np.stack([-half, half], axis=1), rtol=1e-14)
    np.testing.assert_allclose(ref.clamped_ray(simple_camera(), np.array([9.0, -0.5, 2.0])), [1.3, -0.5])


def test_color_from_the_world_direction():
    """Camera at (1, 2, 3) looking along world +x; the Gaussian is in front of it, so d = (1, 0, 0)."""
    rotation = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    position = np.array([1.0, 2.0, 3.0])
    camera = replace(simple_camera(), world_to_camera=np.column_stack([rotation, -rotation @ position]))
    np.testing.assert_allclose(camera.position, position)
    gaussians = isotropic([6, 2, 3], 0.2, 0.5, [0.5, 0.5, 0.5])
    gaussians.sh = np.concatenate([gaussians.sh, [[[10, 20, 30], [1, 2, 3], [0.1, 0.2, -3]]]], axis=1)
    splats = ref.project(gaussians, camera, 1)
    np.testing.assert_allclose(splats.mean2d, [[20, 15]])
    expected = 0.5 - 0.4886025119029199 * np.array([0.1, 0.2, -3])
    np.testing.assert_allclose(splats.color[0], expected)
    np.testing.assert_allclose(ref.project(gaussians, camera, 0).color[0], 0.5)


def test_covariance_of_a_rotated_gaussian():
    """A quarter turn about z (w = z) exchanges the axes x and y; far away perspective is the scale f/z."""
    gaussians = isotropic([0, 0, 10], 1.0, 0.5, [1, 1, 1])
    gaussians.log_scales = np.log([[0.5, 2.0, 1.0]])
    gaussians.quats = np.array([[3.0, 0.0, 0.0, 3.0]])
    splats = ref.project(gaussians, simple_camera(), 0, variance=0.3)
    np.testing.assert_allclose(splats.conic, [[1 / (64 + 0.3), 0, 1 / (4 + 0.3)]], atol=1e-15)
    gaussians.quats = np.array([[np.cos(0.3), 0.0, 0.0, np.sin(0.3)]])  # by 0.6, x toward y
    rotation = np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
    inverse = np.linalg.inv(rotation @ np.diag([4.0, 64.0]) @ rotation.T + 0.3 * np.eye(2))
    splats = ref.project(gaussians, simple_camera(), 0, variance=0.3)
    np.testing.assert_allclose(splats.conic[0], [inverse[0, 0], inverse[0, 1], inverse[1, 1]], rtol=1e-12)


def test_filters_in_closed_form():
    """World filter: s² + f and (s/s')³.  Screen filter: k, and sqrt(det ratio) = V / (V + k) for a disc."""
    scale, variance, k, opacity = 0.1, 0.03, 0.1, 0.6
    gaussians = isotropic([0, 0, 4], scale, opacity, [1, 1, 1])
    gaussians.filter_variance = np.array([variance])
    plain = ref.project(gaussians, simple_camera(), 0, variance=k)
    compensated = ref.project(gaussians, simple_camera(), 0, variance=k, compensate=1.0)
    disc = 100 * (scale**2 + variance)
    np.testing.assert_allclose(plain.conic, [[1 / (disc + k), 0, 1 / (disc + k)]], atol=1e-15)
    np.testing.assert_allclose(plain.opacity, [opacity * (scale**2 / (scale**2 + variance)) ** 1.5])
    np.testing.assert_allclose(compensated.conic, plain.conic)
    np.testing.assert_allclose(compensated.opacity, plain.opacity * disc / (disc + k))
    half = ref.project(gaussians, simple_camera(), 0, variance=k, compensate=0.5)
    np.testing.assert_allclose(half.opacity, plain.opacity * np.sqrt((1 + (disc / (disc + k)) ** 2) / 2))


def test_two_splats_by_hand():
    """Front 0.5 red, behind it 0.4 green, background blue: 0.5 + 0.2 + 0.3."""
    splats = flat_splats(depth=[2, 1], opacity=[0.4, 0.5], color=[[0, 1, 0], [1, 0, 0]])
    image, transmittance, count = ref.blend(splats, 1, 1, np.array([0, 0, 1]))
    np.testing.assert_allclose(image[:, 0, 0], [0.5, 0.2, 0.3])
    np.testing.assert_allclose(transmittance, 0.3)
    assert count[0, 0] == 2


def test_equal_depths_keep_the_order_of_indices():
    splats = flat_splats(depth=[1, 1, 1], opacity=[0.5, 0.5, 0.5], color=np.eye(3))
    image, _, _ = ref.blend(splats, 1, 1, np.zeros(3))
    np.testing.assert_allclose(image[:, 0, 0], [0.5, 0.25, 0.125])


def test_order_of_gaussians_does_not_matter(rng):
    camera = general_camera()
    gaussians = random_gaussians(rng, camera, 1)
    shuffle = np.array([3, 0, 4, 1, 2])
    shuffled = ref.RawGaussians(
        **{
            name: np.take(values, shuffle, axis=0) if np.ndim(values) else values
            for name, values in vars(gaussians).items()
        }
    )
    image = ref.render(gaussians, camera, BACKGROUND, 1).image
    np.testing.assert_array_equal(ref.render(shuffled, camera, BACKGROUND, 1).image, image)


def test_alpha_is_capped():
    splats = flat_splats(depth=[1], opacity=[0.999], color=[[1, 1, 1]])
    image, transmittance, _ = ref.blend(splats, 1, 1, np.zeros(3))
    np.testing.assert_allclose(image, 0.99)
    np.testing.assert_allclose(transmittance, 0.01)
    grad = ref.blend_backward(splats, 1, 1, np.zeros(3), np.ones((3, 1, 1)))
    assert grad.opacity[0] == 0
    np.testing.assert_allclose(grad.color, 0.99)


def test_faint_alpha_is_skipped():
    """alpha < 1/255 is skipped, alpha = 1/255 is not."""
    limit = 1 / 255
    splats = flat_splats(depth=[1, 2], opacity=[np.nextafter(limit, 0), limit], color=[[1, 0, 0], [0, 1, 0]])
    image, _, count = ref.blend(splats, 1, 1, np.zeros(3))
    np.testing.assert_allclose(image[:, 0, 0], [0, limit, 0])
    assert count[0, 0] == 1


def test_negative_sigma_is_skipped():
    """No projection makes such a conic, but rounding does."""
    splats = flat_splats(depth=[1], opacity=[0.5], color=[[1, 1, 1]])
    splats.conic[0] = [-1e-3, 0, -1e-3]
    assert ref.blend(splats, 1, 1, np.zeros(3))[2][0, 0] == 0
    splats.conic[0] = [1e-3, 0, 1e-3]
    assert ref.blend(splats, 1, 1, np.zeros(3))[2][0, 0] == 1


def test_stopping_splat_is_excluded():
    """0.1 · 0.02 · 0.02 < 1e-4: the third splat stops the pixel unseen, and the faint fourth is not reached."""
    splats = flat_splats(depth=[1, 2, 3, 4], opacity=[0.9, 0.98, 0.98, 0.1], color=[*np.eye(3).tolist(), [9, 9, 9]])
    image, transmittance, count = ref.blend(splats, 1, 1, np.ones(3))
    np.testing.assert_allclose(image[:, 0, 0], [0.9 + 0.002, 0.098 + 0.002, 0.002])
    np.testing.assert_allclose(transmittance, 0.002)
    assert count[0, 0] == 2
    grad = ref.blend_backward(splats, 1, 1, np.ones(3), np.ones((3, 1, 1)))
    assert np.all(grad.opacity[2:] == 0)
    assert np.all(grad.color[2:] == 0)


def test_transmittance_of_the_threshold_itself_does_not_stop():
    thresholds = ref.Thresholds(transmittance_min=0.25)
    splats = flat_splats(depth=[1, 2, 3], opacity=[0.5, 0.5, 0.01], color=np.eye(3))
    _, transmittance, count = ref.blend(splats, 1, 1, np.zeros(3), thresholds)
    assert count[0, 0] == 2
    assert transmittance[0, 0] == 0.25


def test_margin_matches_values_computed_by_hand():
    """The second splat is too faint, the third stops the pixel, so that the fourth does not count."""
    splats = flat_splats(depth=[1, 1.25, 2, 3], opacity=[0.5, 0.02, 0.9, 0.0301], color=np.ones((4, 3)))
    thresholds = ref.Thresholds(alpha_min=0.03, alpha_max=0.99, transmittance_min=0.08)
    margin = ref.margin(splats, 1, 1, thresholds)
    np.testing.assert_allclose(margin.alpha, 1 - 0.02 / 0.03)
    np.testing.assert_allclose(margin.transmittance, 1 - 0.5 * 0.1 / 0.08)
    np.testing.assert_allclose(margin.cap, 1 - 0.9 / 0.99)
    np.testing.assert_allclose(margin.depth, 0.25 / 1.25)
    assert ref.margin(splats, 1, 1, ref.SMOOTH_THRESHOLDS)[:2] == (np.inf, np.inf)


# ---- Culling and radius -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "visible"),
    [
        ({}, True),
        ({"means": [[0, 0, 0.5]]}, True),
        ({"means": [[0, 0, np.nextafter(0.5, 0)]]}, False),
        ({"means": [[0, 0, -3]]}, False),
        ({"means": [[0, 0, np.nan]]}, False),
        ({"quats": [[1.1e-6, 0, 0, 0]]}, True),
        ({"quats": [[0.9e-6, 0, 0, 0]]}, False),
        ({"quats": [[np.nan, 0, 0, 0]]}, False),
        ({"logit_opacity": [-np.log(254) + 1e-9]}, True),
        ({"logit_opacity": [-np.log(254) - 1e-9]}, False),
        ({"logit_opacity": [np.nan]}, False),
    ],
)
def test_gaussians_nearer_than_the_near_plane_are_culled(change, visible):
    gaussians = replace(isotropic([0, 0, 2], 0.1, 0.5, [1, 1, 1]), **change)
    splats = ref.project(gaussians, simple_camera(), 0, near=0.5)
    assert splats.visible[0] == visible
    assert (splats.opacity[0] > 0) == visible
    ones = [np.ones(shape) for shape in ((1, 2), (1, 3), 1, (1, 3))]
    grad = ref.project_backward(gaussians, simple_camera(), 0, 0.3, 0.0, splats, *ones)
    assert all(np.any(grad[name] != 0) == visible for name in ("means", "log_scales", "logit_opacity", "sh"))


def test_degenerate_determinant_is_culled():
    """A needle seen end on without a screen filter has no area."""
    gaussians = isotropic([0, 0, 2], 0.1, 0.5, [1, 1, 1])
    gaussians.log_scales = np.array([[-200.0, -200.0, 0.0]])
    assert not ref.project(gaussians, simple_camera(), 0, variance=0.0).visible[0]
    assert ref.project(gaussians, simple_camera(), 0, variance=0.3).visible[0]


def test_radius_of_a_disc():
    """V1 = 18.3 + 0.3, λ = 18.6 + sqrt(0.1) (its floor), 3 sqrt λ = 13.05 -> 14; the opacity has no influence."""
    gaussians = isotropic([0, 0, 2], np.sqrt(18.3) / 20, 0.5, [1, 1, 1])
    assert ref.project(gaussians, simple_camera(), 0).radius[0] == 14
    gaussians.logit_opacity[0] = -30
    splats = ref.project(gaussians, simple_camera(), 0)
    assert splats.radius[0] == 14
    assert not splats.visible[0]


def test_radius_of_an_ellipse():
    """V1 = diag(4.3, 64.3): λ = 64.3, 3 sqrt λ = 24.06 -> 25."""
    gaussians = isotropic([0, 0, 10], 1.0, 0.5, [1, 1, 1])
    gaussians.log_scales = np.log([[0.5, 2.0, 1.0]])
    assert ref.project(gaussians, simple_camera(), 0).radius[0] == 25


@pytest.mark.parametrize(
    ("column", "radius"),
    [
        (-11.51, 0),  # index coordinate -12.01 + 13 + 15 < 16: ends before the first tile
        (-11.49, 13),
        (61.49, 13),  # index coordinate 60.99 - 13 < 48: starts in the last of three tiles
        (61.51, 0),
    ],
)
def test_radius_is_zero_outside_the_tiles(column, radius):
    camera = replace(simple_camera(), cx=column)  # on the axis still, so that the disc stays a disc
    gaussians = isotropic([0, 0, 2], 0.2, 0.5, [1, 1, 1])
    assert ref.project(gaussians, camera, 0).radius[0] == radius
    turned = replace(simple_camera(HEIGHT, WIDTH), cy=column)
    assert ref.project(gaussians, turned, 0).radius[0] == radius
    assert ref.project(replace(gaussians, means=[[0, 0, 0.1]]), camera, 0).radius[0] == 0


# ---- Losses, Adam, density control --------------------------------------------------------------------------------


@pytest.mark.parametrize("function", [ref.l1, ref.l2, ref.dssim])
def test_loss_gradients(rng, function):
    x, y = rng.uniform(0, 1, (2, 2, 12, 6))
    _, grad = function(x, y)
    error = relative_error(grad, five_point(lambda: function(x, y)[0], x))
    print(f"{function.__name__}: worst relative error {error:.1e}")
    assert error <= FD_TOLERANCE, f"{function.__name__}: worst relative error {error:.1e}"


def test_losses_match_values_computed_by_hand():
    x, y = np.zeros((3, 2, 2)), np.zeros((3, 2, 2))
    x[1, 0, 1] = 0.6
    np.testing.assert_allclose(ref.l1(x, y)[0], 0.6 / 12)
    np.testing.assert_allclose(ref.l2(x, y)[0], 0.36 / 12)
    np.testing.assert_allclose(ref.psnr(x, y), 10 * np.log10(12 / 0.36))
    np.testing.assert_allclose(ref.psnr(np.full((3, 2, 2), 0.1), y), 20)


def test_ssim_taps_match_the_published_ones():
    """Against the published numbers."""
    published = [0.00102838, 0.00759876, 0.03600077, 0.10936069, 0.21300554, 0.26601172]
    np.testing.assert_allclose(ref.ssim_taps(), published + published[4::-1], atol=5e-9)


def test_ssim_against_scikit_image(rng):
    """It reflects at the border where we have zeros, so only the interior agrees."""
    x, y = rng.uniform(0, 1, (2, 3, 30, 25))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1, "full": True}
    _, expected = structural_similarity(x, y, channel_axis=0, **options)
    interior = (slice(None), slice(5, -5), slice(5, -5))
    ours = ref.ssim_map(x, y)
    np.testing.assert_allclose(ours[interior], expected[interior], rtol=1e-12, atol=1e-13)
    assert np.max(np.abs(ours - expected)) > 1e-3
    np.testing.assert_allclose(ref.dssim(x, y)[0], 1 - ours.mean(), rtol=1e-14)


def test_ssim_border_is_zero_padded():
    """Two constant images in the corner: all five means are fractions q of the constants' own."""
    x, y = np.full((1, 12, 12), 0.8), np.full((1, 12, 12), 0.4)
    q = ref.ssim_taps()[5:].sum() ** 2  # the window's part inside the image
    luminance = (2 * q * q * 0.32 + 1e-4) / (q * q * 0.8 + 1e-4)
    structure = (2 * (q - q * q) * 0.32 + 9e-4) / ((q - q * q) * 0.8 + 9e-4)
    np.testing.assert_allclose(ref.ssim_map(x, y)[0, 0, 0], luminance * structure, rtol=1e-12)


def test_adam_matches_its_closed_form(rng):
    """Pixel sums after t steps: (1-β) Σ β^(t-k) g_k^p, divided by 1-β^t."""
    steps, rate = 6, 0.01
    gradients = rng.normal(0, 1, (steps, 4))
    parameter, moment1, moment2 = np.ones(4), np.zeros(4), np.zeros(4)
    expected = np.ones(4)
    for t in range(1, steps + 1):
        parameter, moment1, moment2 = ref.adam_step(parameter, gradients[t - 1], moment1, moment2, t, rate)
        age = np.arange(t - 1, -1, -1)[:, None]
        mean = 0.1 * np.sum(0.9**age * gradients[:t], axis=0) / (1 - 0.9**t)
        square = 0.001 * np.sum(0.999**age * gradients[:t] ** 2, axis=0) / (1 - 0.999**t)
        expected = expected - rate * mean / np.sqrt(square)
        np.testing.assert_allclose(parameter, expected, rtol=1e-12)


def test_adam_of_visible_rows_leaves_other_rows(rng):
    state, seen = rng.normal(1, 0.1, (4, 3, 2)), np.array([True, False, True])
    parameter, gradient, moment1, moment2 = state
    whole = ref.adam_step(parameter, gradient, moment1, moment2, 3, 0.01)
    for after, updated, before in zip(
        ref.adam_step(parameter, gradient, moment1, moment2, 3, 0.01, mask=seen),
        whole,
        (parameter, moment1, moment2),
        strict=True,
    ):
        np.testing.assert_array_equal(after[seen], updated[seen])
        np.testing.assert_array_equal(after[1], before[1])


def test_adam_epsilon_is_outside_the_root():
    """The first step is rate · g / (|g| + ε): half the rate at g = ε, the whole of it at g = 1."""
    parameter, _, _ = ref.adam_step(np.zeros(2), np.array([1e-15, -1.0]), np.zeros(2), np.zeros(2), 1, 0.01)
    np.testing.assert_allclose(parameter, [-0.005, 0.01], rtol=1e-9)


def test_screen_gradient_and_its_mean():
    grad = np.array([[0.3, 0.0], [0.3, -0.4]])
    np.testing.assert_allclose(ref.screen_gradient(grad, 20, 20), [3, 5])
    np.testing.assert_allclose(ref.screen_gradient(grad, 40, 10), [6, np.hypot(6, 2)])
    np.testing.assert_allclose(ref.mean_gradient(np.array([6.0, 3.0, 0.0]), np.array([4, 1, 0])), [1.5, 3, 0])


def test_density_action_follows_from_the_thresholds():
    """Extent 10: dense is 0.1, too large is 1."""
    cases = [  # gradient, largest scale, opacity, prune_large, action
        (1.9e-4, 0.05, 0.5, False, ref.KEEP),
        (2e-4, 0.05, 0.5, False, ref.CLONE),
        (2e-4, 0.1, 0.5, False, ref.CLONE),
        (2e-4, 0.11, 0.5, False, ref.SPLIT),
        (1.9e-4, 0.11, 0.5, False, ref.KEEP),
        (3e-4, 0.05, 0.0049, False, ref.PRUNE),  # the copy is pruned with it
        (3e-4, 0.5, 0.0049, False, ref.PRUNE),
        (0, 0.5, 0.005, False, ref.KEEP),
        (0, 1.1, 0.5, False, ref.KEEP),
        (0, 1.0, 0.5, True, ref.KEEP),
        (0, 1.1, 0.5, True, ref.PRUNE),
        (3e-4, 1.5, 0.5, True, ref.SPLIT),  # its children, 0.94, are small enough
        (3e-4, 1.7, 0.5, True, ref.PRUNE),
    ]
    for gradient, scale, opacity, prune_large, expected in cases:
        actions = ref.adc_actions(np.array([gradient]), np.array([scale]), np.array([opacity]), 10.0, prune_large)
        assert actions.tolist() == [expected], (gradient, scale, opacity, prune_large)


def test_density_actions_of_absgs():
    """Clones by ḡ >= 2e-4, splits by ḡabs >= 4e-4, boundary 0.001 of the extent."""
    gradient = np.array([3e-4, 1e-4, 3e-4, 1e-4])
    absolute = np.array([3e-4, 5e-4, 3e-4, 5e-4])
    scale = np.array([0.009, 0.009, 0.011, 0.011])
    rule = ref.DensityConstants(split_gradient=4e-4, dense=0.001)
    actions = ref.adc_actions(gradient, scale, np.full(4, 0.5), 10.0, False, rule, absolute)
    assert actions.tolist() == [ref.CLONE, ref.KEEP, ref.KEEP, ref.SPLIT]


def test_opacity_reset_only_lowers_opacities():
    def opacity(logit):
        return 1 / (1 + np.exp(-logit))

    logit = np.array([2.0, -7.0])
    np.testing.assert_allclose(opacity(ref.reset_logit(logit)), [0.01, opacity(-7.0)])
    np.testing.assert_allclose(opacity(ref.reset_logit(logit, 0.5)), [0.02, opacity(-7.0)])


def test_gradients_of_the_colors_of_a_photograph(rng):
    """By the image and by the matrix; some pixels are cut."""
    gradient = rng.normal(size=(3, 6, 7))
    image = rng.uniform(-0.2, 1.4, gradient.shape)
    matrix = np.column_stack([np.eye(3) + rng.normal(0, 0.2, (3, 3)), rng.normal(0, 0.1, 3)])
    assert 0.1 < np.mean(ref.apply_color_matrix(image, matrix) == 1) < 0.7
    grad_image, grad_matrix = ref.color_matrix_backward(image, matrix, gradient)
    for analytic, array in ((grad_image, image), (grad_matrix, matrix)):
        numeric = five_point(lambda: (gradient * ref.apply_color_matrix(image, matrix)).sum(), array)
        assert relative_error(analytic, numeric) < FD_TOLERANCE


@pytest.mark.parametrize("nodes", [(3, 2, 4), (1, 4, 2), (2, 1, 1)])
def test_gradients_of_a_grid_of_colors(rng, nodes):
    """By the image, through the luminance too, by the grid, and of its smoothness; some pixels are cut."""
    gradient, grid = rng.normal(size=(3, 5, 6)), rng.normal(0, 0.2, (3, 4, *nodes))
    image = rng.uniform(-0.2, 1.3, gradient.shape)
    assert 0.05 < np.mean(ref.apply_color_grid(image, grid) == 1) < 0.7
    grad_image, grad_grid = ref.color_grid_backward(image, grid, gradient)
    for analytic, array in ((grad_image, image), (grad_grid, grid)):
        numeric = five_point(lambda: (gradient * ref.apply_color_grid(image, grid)).sum(), array)
        assert relative_error(analytic, numeric) < FD_TOLERANCE
    value, slope = ref.grid_smoothness(grid)
    assert value > 0
    assert relative_error(slope, five_point(lambda: ref.grid_smoothness(grid)[0], grid)) < FD_TOLERANCE


def test_grid_of_equal_matrices_is_constant_and_meets_its_nodes(rng):
    image, grid = rng.uniform(0, 1, (3, 6, 7)), rng.normal(0, 0.2, (3, 4, 1, 1, 1))
    expected = ref.apply_color_matrix(image, np.eye(3, 4) + grid[:, :, 0, 0, 0])
    np.testing.assert_allclose(ref.apply_color_grid(image, np.tile(grid, (1, 1, 4, 3, 2))), expected)
    gray = np.full((3, 1, 1), 1 / 3)  # the second of four levels, in the middle of the image
    grid = rng.normal(0, 0.2, (3, 4, 4, 3, 3))
    matrix = np.eye(3, 4) + grid[:, :, 1, 1, 1]
    np.testing.assert_allclose(ref.apply_color_grid(gray, grid), ref.apply_color_matrix(gray, matrix))


def test_removing_the_grid_mean_keeps_local_differences(rng):
    vignette = np.zeros((4, 3, 4, 2, 3, 3))
    vignette[..., 1, 1] = 0.3  # in the middle of all photographs
    result = ref.center_grids(vignette + rng.normal(size=(1, 3, 4, 2, 1, 1)))
    np.testing.assert_allclose(result.mean(axis=(0, 4, 5)), 0, atol=1e-15)
    np.testing.assert_allclose(result[..., 1, 1] - result[..., 0, 0], 0.3)


def test_white_balance_keeps_the_luminance_of_its_gains():
    gains = np.log(np.diag(ref.gain_matrix(0.3, 0.1, -0.2)))
    assert gains @ [0.299, 0.587, 0.114] == pytest.approx(0.3)


def test_gradients_of_a_sky(rng):
    """By its texels, through splats in front of it by its planes, and of the loss of what covers it."""
    side, height, width = 8, 6, 7
    texels, gradient = rng.random((side, side, 3)), rng.normal(size=(3, height, width))
    directions, left = rng.normal(size=(height, width, 3)), rng.random((height, width))
    numeric = five_point(lambda: (gradient * left * ref.sky_image(texels, directions)).sum(), texels)
    assert relative_error(ref.sky_gradient(side, directions, left, gradient), numeric) < FD_TOLERANCE
    chosen = rng.random((height, width)) < 0.5
    _, grad_left = ref.sky_cover(chosen, left, 0.3)
    numeric = five_point(lambda: ref.sky_cover(chosen, left, 0.3)[0], left)
    assert relative_error(grad_left, numeric) < FD_TOLERANCE


def test_gradients_of_a_layer_before_an_image(rng):
    """By the image behind it, and of the loss of what it covers."""
    layer, image, gradient = rng.random((3, 6, 7)), rng.random((4, 6, 7)), rng.normal(size=(4, 6, 7))
    left = rng.random((6, 7))
    numeric = five_point(lambda: (gradient * ref.overlay(layer, left, image)).sum(), image)
    assert relative_error(ref.gradient_behind(left, gradient), numeric) < FD_TOLERANCE
    numeric = five_point(lambda: ref.layer_cover(left, 0.3)[0], left)
    assert relative_error(ref.layer_cover(left, 0.3)[1], numeric) < FD_TOLERANCE


def test_sky_has_no_seam(rng):
    """Neighboring directions have neighboring colors everywhere, and a color of all texels is that of the sky."""
    texels, directions = rng.random((9, 9, 3)), rng.normal(size=(40, 50, 3))
    directions[:10, :, 0] = 0  # where octants meet
    near = directions + 1e-7 * rng.normal(size=directions.shape)
    assert np.abs(ref.sky_image(texels, directions) - ref.sky_image(texels, near)).max() < 1e-5
    np.testing.assert_allclose(ref.sky_image(np.full((9, 9, 1), 0.3), directions), 0.3)


def test_pixels_show_the_sky_where_six_of_nine_match():
    sky = np.zeros((3, 5, 5))
    photograph = np.zeros((3, 5, 5))
    photograph[:, :2] = 1
    assert ref.sky_mask(sky, photograph, 0.1).any(axis=1).tolist() == [False, False, True, True, True]


@pytest.mark.parametrize(("degree", "turns"), each_once([1, 2, 3], [False, True]))
def test_gradients_of_a_motion(rng, degree, turns):
    """By the motion and by the logit at the center, of a sum over what is there at a time."""
    count, time = 6, 0.4
    motion = rng.normal(0, 0.4, (count, 2 + 3 * degree + 4 * turns))
    motion[:, 3], motion[:, 4] = rng.uniform(0.2, 0.6, count), rng.normal(-1, 0.2, count)
    means, quats, logit = rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), rng.normal(size=count)
    weights = [rng.normal(size=table.shape) for table in (means, quats, logit)]

    def value() -> float:
        tables = ref.move_gaussians(motion, means, quats, logit, time, degree, turns)
        return sum(float((weight * table).sum()) for weight, table in zip(weights, tables, strict=True))

    grad_motion, grad_logit = ref.move_gaussians_backward(motion, logit, *weights, time, degree, turns)
    assert grad_motion.all()
    assert relative_error(grad_motion, five_point(value, motion)) < FD_TOLERANCE
    assert relative_error(grad_logit, five_point(value, logit)) < FD_TOLERANCE
