"""Image sizes that follow from the detail of the photographs, and the matching number of Gaussians."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Decay
from clsplat.density.budget import BudgetContext
from clsplat.methods.dash import Momentum
from clsplat.photos.detail import KNOTS, LEVELS, DetailDivisor, Spectrum, compute_knots, describe_sizes
from clsplat.photos.sampling import ViewSettings
from clsplat.pipeline.loading import load
from clsplat.training.adam import Rates

BOUNDS = np.linspace(0, 1, LEVELS + 1)
NOISE = Spectrum(BOUNDS**2)  # as many amplitudes at every frequency of the plane
NATURAL = Spectrum(BOUNDS)  # amplitudes that fall as 1 / frequency


def test_flat_spectrum_begins_with_a_quarter_of_the_pixels():
    steps, divisors = compute_knots([NOISE, NOISE], 27000, 8)
    amplitudes = [0.25 + 0.75 * i / (KNOTS - 1) for i in range(KNOTS)]
    assert divisors == pytest.approx([a**-0.5 for a in amplitudes], rel=2e-3)
    assert steps == pytest.approx([27000 * math.log(4 * a) / math.log(4) for a in amplitudes], rel=2e-3, abs=1e-6)


def test_natural_spectrum_begins_with_a_sixteenth():
    steps, divisors = compute_knots([NATURAL], 6000, 8)
    assert divisors[0] == pytest.approx(4, rel=2e-3)
    middle = 0.25 + 0.75 * 10 / (KNOTS - 1)
    assert (divisors[10], steps[10]) == (
        pytest.approx(1 / middle, rel=2e-3),
        pytest.approx(6000 * math.log(4 * middle) / math.log(4), rel=2e-3),
    )


def test_largest_divisor_follows_the_most_detailed_image():
    assert compute_knots([NATURAL, NOISE], 6000, 8)[1][0] == pytest.approx(2, rel=2e-3)
    assert compute_knots([NATURAL], 6000, 3)[1][0] == 3


def test_size_is_full_from_the_start_without_detail():
    gray = DetailDivisor(follows="detail", until=900).to_schedule([np.full((40, 60, 3), 77, np.uint8)])
    assert gray.points == [[0, 1]]
    assert "full size" in describe_sizes(gray)


@pytest.mark.parametrize("size", [(48, 64), (33, 57), (1, 20)])
def test_spectrum_sums_over_the_centered_window(size):
    image = np.random.default_rng(3).integers(0, 256, (*size, 3), dtype=np.uint8)
    amplitudes = np.abs(np.fft.fft2(image.astype(np.float64), axes=(0, 1))).sum(axis=2)
    spectrum = Spectrum.from_image(image)
    assert spectrum.total == pytest.approx(amplitudes.sum(), rel=1e-5)
    down, right = (np.abs(np.fft.fftfreq(n)) * 2 for n in size)
    for divisor in (1.5, 2.0, 4.0):
        inside = np.maximum(down[:, None], right[None, :]) <= 1 / divisor
        below, above = (spectrum.amplitude(1 / (1 / divisor + shift / LEVELS)) for shift in (-1.001, 1.001))
        assert below * (1 - 1e-5) <= amplitudes[inside].sum() <= above * (1 + 1e-5)


def test_size_grows_in_integer_steps_to_full():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    smooth = np.repeat(np.repeat(image[::4, ::4], 4, axis=0), 4, axis=1)
    settings = DetailDivisor(follows="detail", until=3000, every=100, start=500)
    points = settings.to_schedule([smooth]).points
    assert points[0][0] == 0
    assert points[0][1] > 1
    assert points[-1][1] == 1
    assert points[-1][0] <= 3001
    assert all(step > 500 and step % 100 == 1 for step, _ in points[1:])
    assert all(value == int(value) for _, value in points)
    steps, divisors = compute_knots([Spectrum.from_image(smooth)], 3000, 8)
    sizes = settings.to_schedule([smooth])
    for step in (700, 1500, 2300, 2900):  # the floor of the knots' value, linear in the number of pixels
        assert sizes.at(step + 1) == int(np.interp(step, steps, divisors**-2) ** -0.5)


def test_settings_that_follow_detail_are_resolved_before_use():
    views = ViewSettings(resolution={"follows": "detail", "until": 900})
    with pytest.raises(ConfigError, match="needs photos"):
        views.divisor(1)
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, 32:] = 255
    resolved = views.resolve(lambda: [image])
    assert resolved.divisor(1) > 1
    assert resolved.divisor(1000) == 1
    full = resolved.first_large_step(1000)
    assert resolved.divisor(full) == 1 < resolved.divisor(full - 1)
    assert resolved.resolve(lambda: []) is resolved


def test_rate_of_the_means_is_constant_up_to_the_full_size():
    rates = Rates(means={"initial": 1e-2, "final": 1e-4, "start": "full_size", "until": 1000})
    assert rates.resolve(601).means == Decay(initial=1e-2, final=1e-4, start=601, over=399)
    means = [rates.resolve(600).at(step, 2.0)["means"] for step in (1, 600, 800, 1000, 2000)]
    assert means == pytest.approx([2e-2, 2e-2, 2e-3, 2e-4, 2e-4], rel=1e-9)
    assert rates.resolve(5000).means.over == 1


def test_rates_waiting_for_full_size_are_resolved_before_use():
    rates = load("dash").settings.training.rates
    with pytest.raises(ConfigError, match=r"start: full_size.* the rates that `resolve\(step\)` returns"):
        rates.at(1, 1.0)
    assert rates.resolve(1).at(1, 1.0)["means"] == pytest.approx(rates.means.initial, rel=1e-3)


def edit_of(count: int, eager: int, step: int = 100) -> SimpleNamespace:
    means = np.where(np.arange(count) < eager, 1e-3, 1e-5).astype(np.float32)
    stats = SimpleNamespace(mean=lambda name: means)
    return SimpleNamespace(gaussians=SimpleNamespace(count=count), stats=stats, evaluate=lambda value: value, step=step)


def test_momentum_follows_its_formulas():
    budget, numbers = Momentum(), {}
    begin = 1000
    assert budget.limit(edit_of(begin, 300), BudgetContext(0.1, 5, 4.0), numbers) == 1200  # at most a fifth more
    assert numbers == {"momentum/start": begin, "momentum/sum": 5200}  # .98 * 5000 + 300
    target = begin + 5200 / 4**1.7
    assert budget.limit(edit_of(1200, 0), BudgetContext(0.3, 5, 4.0), numbers) == int(
        1200 * (1 + min(0.2, target / 1200 - 1))
    )
    assert numbers["momentum/sum"] == 5200  # it does not fall
    assert budget.limit(edit_of(6000, 900), BudgetContext(0.9, 5, 1.0), numbers) == 6200
    assert numbers["momentum/sum"] == 5996
    assert budget.limit(edit_of(6900, 0), BudgetContext(0.95, 1, 2.0), numbers) == 6996  # the last edit reaches it
    assert budget.limit(edit_of(7400, 0), BudgetContext(0.95, 1, 1.0), numbers) == 7400  # pruned ones are replaced


def test_momentum_ends_at_its_setting():
    budget, numbers = Momentum(gaussians=2000), {}
    for share in (0.2, 0.5, 0.8):
        assert budget.limit(edit_of(1950, 1900), BudgetContext(share, 5, 1.0), numbers) == 2000
