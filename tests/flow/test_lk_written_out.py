"""One step of the closed-form estimator against its formulas written out in numpy
(docs/flow_closed_form.md and the heads of lk/estimate.py, lk/level.py): what the data say, how far
they are trusted, how far a step goes."""

import math

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from codesign.flow import estimate_lk
from codesign.flow.lk import cells
from codesign.flow.lk.polynomials import Polynomials
from tests.certain_case import certain
from tests.flow.test_lk import moving
from tests.numbers import randn64

PRIOR_PX = 3.0
FLOOR = 0.02


def pooled(image, step):
    """Means of squares of step x step."""
    height, width = (size // step for size in image.shape[-2:])
    cut = image[..., : height * step, : width * step]
    return cut.reshape(*image.shape[:-2], height, step, width, step).mean((-3, -1))


def gaussian(sigma_px, step):
    """Taps, in samples step px apart, that with the means of step px have the standard deviation
    sigma."""
    spread = math.sqrt(sigma_px**2 - (step**2 - 1) / 12) / step
    reach = int((3.0 if step == 1 else 2.5) * spread + 0.5)
    taps = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * spread**2))
    return taps / taps.sum()


def blurred(image, taps):
    return correlate1d(correlate1d(image, taps, -1, mode="mirror"), taps, -2, mode="mirror")


def slope_of_white_noise(taps, step):
    """Variance per px^2 of the slope in x at the middle of an image of white noise: the sum over
    all pixels of the square of what one pixel does there."""
    count = len(taps) + 4
    middle = count // 2
    # [sample, sample that is lit]
    answer = np.array([correlate1d(row, taps) for row in np.eye(count)]).T
    each = np.repeat(answer, step, 1) / step  # [sample, pixel that is lit]
    slope = (each[middle + 1] - each[middle - 1]) / (2 * step)
    return (slope**2).sum() * (each[middle] ** 2).sum()


def basis(x, y, terms):
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y][:terms])


def prior_precision(terms):
    """Of u = sum p b, v = sum q b: shifts, then divergence, rotation and shears as half sums, then
    quadratics."""
    unit = np.eye(2 * terms)
    rows = [(unit[0], 1.0), (unit[terms], 1.0)]
    if terms >= 3:
        ux, uy, vx, vy = unit[1], unit[2], unit[terms + 1], unit[terms + 2]
        rows += [
            ((ux + vy) / 2, 0.35),
            ((vx - uy) / 2, 0.35),
            ((ux - vy) / 2, 0.25),
            ((vx + uy) / 2, 0.25),
        ]
    rows += [(unit[i + shift], 0.15) for i in range(3, terms) for shift in (0, terms)]
    return sum(np.outer(row, row) / (share * PRIOR_PX) ** 2 for row, share in rows)


def evidence(volume, terms, sigma_px):
    """Precision and pull of one level at zero flow."""
    counts = volume.counts[0].numpy()
    share = (volume.collected_s / volume.collected_s.sum()).numpy()
    time = (volume.centroid_s / volume.collected_s.sum()).numpy() - 0.5
    step = 2 ** int(math.log2(max(sigma_px, 1)))
    taps = gaussian(sigma_px, step)
    bins = blurred(pooled((counts[0] - counts[1]) / share[:, None, None], step), taps)
    density = pooled(counts.sum((0, 1)), step)
    centred = time - (share * time).sum()
    spread = (share * centred**2).sum()
    mean = np.einsum("n,nyx->yx", share, bins)
    slope = np.einsum("n,nyx->yx", share * centred, bins) / spread
    by_y, by_x = (d / step for d in np.gradient(mean))
    height, width = counts.shape[-2:]
    at = [
        np.arange(size // step) * step + (step - 1) / 2 - (size - 1) / 2 for size in (width, height)
    ]
    x, y = np.meshgrid(*at)
    ends = [
        np.clip(((size - 1) / 2 - np.abs(place)) / (1 + sigma_px), 0, 1)
        for size, place in ((width, x), (height, y))
    ]
    # of the first and of the last bin
    fade = np.prod([end**2 * (3 - 2 * end) for end in ends], 0) ** 2
    b = basis(x / (max(width, height) / 2), y / (max(width, height) / 2), terms)
    g = np.concatenate([by_x * b, by_y * b])
    normal = np.einsum("yx,iyx,jyx->ij", fade, g, g)
    right = -np.einsum("yx,iyx,yx->i", fade, g, slope)
    crowd = np.einsum("yx,yx,iyx,jyx->ij", fade, density, b, b)
    scattered = np.kron(np.eye(2), crowd) * slope_of_white_noise(taps, step)
    # directions in which nothing is seen count as noise
    prior = prior_precision(terms)
    scattered = (
        scattered
        + 1e-5 * np.trace(np.linalg.solve(prior, normal + scattered)) / (2 * terms) * prior
    )
    z, vectors = np.linalg.eig(np.linalg.solve(normal + scattered, scattered))
    trust = (vectors * ((1 - z) ** 4 / ((1 - z) ** 4 + (3 * z) ** 4))) @ np.linalg.inv(vectors)
    per_event = 1 / (spread * 4 * math.pi * sigma_px**2)
    step_to_fit = np.linalg.solve(normal + scattered, right)
    left = (fade * slope**2).sum() - 2 * right @ step_to_fit + step_to_fit @ normal @ step_to_fit
    few = 10 / step**2 * per_event  # ten events' worth, on samples that stand for step^2 pixels
    expected = (fade * density).sum() * per_event
    noise = per_event * (left + FLOOR * expected + few) / (expected + few)
    scale = 1.7 * 4 * math.pi * sigma_px**2 / step**2 * noise
    return (normal @ trust / scale).real, (right @ trust / scale).real


def mean_square(parameters, terms):
    """Mean squared length of the flow over the square [-1, 1]^2, by quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    x, y = np.meshgrid(nodes, nodes)
    flow = parameters.reshape(2, terms) @ basis(x.ravel(), y.ravel(), terms)
    return ((flow**2).sum(0) * np.outer(weights, weights).ravel()).sum() / 4


def one_step(volume, terms, sigma_px):
    """Flow [2, H, W] and covariance [3, H, W] after one Gauss-Newton step from zero flow."""
    precision, pull = evidence(volume, terms, sigma_px)
    precision = precision + prior_precision(terms)
    change = np.linalg.solve(precision, pull)
    p = change / math.sqrt(1 + mean_square(change, terms) / (2 * sigma_px) ** 2)
    height, width = volume.counts.shape[-2:]
    half = max(height, width) / 2
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    flow = np.zeros((2, height, width))
    for _ in range(60):  # w(x) = v(x + w(x) / 2)
        b = basis((x + flow[0] / 2) / half, (y + flow[1] / 2) / half, terms)
        flow = np.einsum("ck,kyx->cyx", p.reshape(2, terms), b)
    spread = np.linalg.inv(precision).reshape(2, terms, 2, terms)
    covariance = np.einsum("kyx,akbl,lyx->abyx", b, spread, b)
    return flow, np.stack([covariance[0, 0], covariance[0, 1], covariance[1, 1]])


@pytest.mark.parametrize("sigma_px", [1.0, 1.5, 4.0])
@pytest.mark.parametrize(("model", "terms"), [("constant", 1), ("affine", 3), ("quadratic", 6)])
@pytest.mark.parametrize("per_pixel", [8.0, 0.01])
def test_one_step_is_that_of_the_formulas_written_out(
    model, terms, sigma_px, per_pixel, monkeypatch
):
    # the polynomial by itself: see test_lk_local for what it leaves
    monkeypatch.setattr(cells, "SIZES", (1e-9,))
    # plenty of events and large motion, where the step is limited; a hundredth of an event per
    # pixel, where the prior and the few events of the start decide
    volume, _ = moving(3, ((0.02, -0.03), (0.01, 0.04)), (5.0, -4.0), per_pixel, steps=20)
    field = certain(estimate_lk(volume, model, PRIOR_PX, (sigma_px,), 1, FLOOR))
    flow, covariance = one_step(volume, terms, sigma_px)
    found = field.flow_px[0].numpy()
    # the estimator adds ridges of 1e-6 and stops its fixed point after four rounds, each a factor
    # of 0.04
    assert np.abs(found - flow).max() <= 1e-4 * np.abs(flow).max()
    assert (
        np.abs(field.covariance_px2[0].numpy() - covariance).max()
        <= 1e-4 * np.abs(covariance).max()
    )


@pytest.mark.parametrize(("model", "terms"), [("constant", 1), ("affine", 3), ("quadratic", 6)])
def test_the_length_of_a_step_is_its_mean_over_the_image(model, terms, generator):
    parameters = randn64(generator, 5, 2 * terms)
    found = Polynomials(model, 40, 40).mean_square(parameters)
    assert found.tolist() == pytest.approx(
        [mean_square(p, terms) for p in parameters.numpy()], rel=1e-12
    )
