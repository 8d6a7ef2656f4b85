"""Long lenses are traced in segments: the same rays, failures and gradients as in one kernel."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Status, Surface, trace

D = torch.float64
GLASS = Glass.from_indices(1.51, 1.5, 1.49, "g")


STRONG = {3: 11.0, 12: 9.0, 22: 7.5}  # radii that outer rays miss


def long_lens():
    """Weak and strong surfaces, an asphere, a mirror, a shifted face and a stop; 27 surfaces."""
    surfaces = []
    for i in range(27):
        radius = STRONG.get(i, 300.0) * (-1 if i % 2 else 1)
        surfaces.append(
            Surface(
                math.inf if i == 16 else radius,
                1.0 + 0.1 * i,
                None if i % 2 else GLASS,
                4.0 if i == 4 else 7.0 if i in STRONG else 14.0,
                conic=0.0 if i in STRONG else 0.3 * (i % 3),
                asphere=(0.0, 1e-6) if i == 12 else (),
                is_stop=i == 4,
                decentre_mm=(0.05, -0.02) if i == 20 else (0.0, 0.0),
            )
        )
    surfaces[24] = Surface(-400.0, 3.0, None, 14.0, mirror=True)
    return GeoLens(surfaces, 8.0)


def run(geo):
    y = torch.linspace(-13, 13, 53, dtype=D)
    origin = torch.stack([0.2 * y, y, torch.full_like(y, -5.0)], 1).requires_grad_()
    direction = torch.nn.functional.normalize(torch.stack([0 * y, 0.02 * y, torch.ones_like(y)], 1), dim=1)
    out = geo.trace(origin, direction)
    total = (
        (out.position_mm.square().sum(1) + out.optical_path_mm)[out.status == Status.OK].sum()
        + out.weight.sum()
        + out.deficit.sum()
    )
    learned = [p for p in geo.parameters() if p.numel()]
    return out, torch.autograd.grad(total, [origin, *learned])


@pytest.mark.parametrize("to_plane", [True, False])
def test_segments_give_what_one_kernel_gives(monkeypatch, to_plane):
    geo = long_lens()
    if not to_plane:
        whole = geo.prescription
        monkeypatch.setattr(geo, "prescription", lambda wavelength_um: whole(wavelength_um).until(26))
    parts, slopes = run(geo)
    monkeypatch.setattr(trace, "LONGEST", 100)
    one, wanted = run(geo)
    assert int((one.status == Status.OK).sum()) > 5
    assert len({at // trace.SEGMENT for at in one.failed_surface.tolist() if at >= 0}) > 1
    for name in ("status", "failed_surface", "inside"):
        assert torch.equal(getattr(parts, name), getattr(one, name)), name
    alive = one.status == Status.OK
    for name in ("position_mm", "direction", "optical_path_mm"):
        # rounding of 60 mm, magnified by 27 surfaces
        torch.testing.assert_close(getattr(parts, name)[alive], getattr(one, name)[alive], rtol=0, atol=1e-11)
    torch.testing.assert_close(parts.weight, one.weight, rtol=0, atol=1e-12)
    torch.testing.assert_close(parts.deficit, one.deficit, rtol=0, atol=1e-11)
    for slope, other in zip(slopes, wanted, strict=True):
        torch.testing.assert_close(slope, other, rtol=1e-10, atol=1e-10 * float(other.abs().max()))


def test_a_short_lens_stays_one_kernel():
    assert len(lens.load("double-gauss").surfaces) <= trace.LONGEST
