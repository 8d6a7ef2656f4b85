"""Lenses that several tests ask for and what they ask of them in one word; lens files to read and
to spoil: the good files, faults and facts of files.txt, and exchanges within them."""

import json
import math
import re
from pathlib import Path

import numpy as np
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Surface
from tests.numbers import f64, rand64, seeded

NAMES = ("cooke-triplet", "double-gauss", "la1509")
LINES = (0.5875618, 0.4861327, 0.6562725)
PLANE = math.inf


def close(found, truth, rtol=0.0, atol=0.0):
    """Whether numbers agree with their truth, or all with one: away by no more than the larger of
    both."""
    found, truth = (
        v.detach() if isinstance(v, torch.Tensor) else np.array(v) for v in (found, truth)
    )
    found = torch.as_tensor(found) * f64(1.0)
    truth = (torch.as_tensor(truth) * f64(1.0)).expand_as(found)
    allowed = torch.clamp(rtol * truth.abs(), min=atol)
    near = ((found - truth).abs() <= allowed) | (found == truth)
    assert near.all(), f"{found} is not {truth}"


def glass(n):
    """A glass of one index at every wavelength."""
    return Glass.from_indices(n, n, n)


def efl(geo):
    return geo.first_order().efl_mm.item()


def half_field(name):
    return math.radians(lens.half_field_deg(name))


def reference(name, shared):
    """The page of reference values of a published lens."""
    return json.loads(shared(f"refs/lens/{name.replace('-', '_')}.json").read_text())


def paraboloid(diameter=5.0, focal_mm=100.0, defocus_mm=0.0):
    """A mirror that is perfect on its axis."""
    surface = Surface(
        -2 * focal_mm, focal_mm + defocus_mm, None, 30.0, conic=-1.0, is_stop=True, mirror=True
    )
    return GeoLens([surface], diameter)


class Asked(torch.nn.Module):
    """A figure of a lens as its forward pass, for torch.func."""

    def __init__(self, geo, figure):
        super().__init__()
        self.geo, self.figure = geo, figure

    def forward(self):
        return self.figure(self.geo)


def figure_of(geo, figure, parameters):
    """The function of the values of some Parameters of a lens that a figure of the lens is."""
    names = {id(value): name for name, value in geo.named_parameters()}

    def function(*values):
        given = {f"geo.{names[id(p)]}": value for p, value in zip(parameters, values, strict=True)}
        return torch.func.functional_call(Asked(geo, figure), given, ())

    return function


def check_gradient(function, *values, step=1e-4, rel=1e-6, seed=0):
    """The slope of a scalar function along a direction drawn for every tensor, in proportion to its
    size, against central differences of fourth order."""
    generator = seeded(seed)
    leaves = [v.detach().clone().requires_grad_() for v in values]
    slopes = torch.autograd.grad(function(*leaves), leaves)
    for at, (value, slope) in enumerate(zip(values, slopes, strict=True)):
        value = value.detach()
        drawn = rand64(generator, value.shape).to(value) + 0.5
        size = value.abs().mean() if value.any() else torch.ones_like(value.sum())
        direction = drawn * torch.where(value == 0, size, value)

        def moved(amount, at=at, value=value, direction=direction):
            others = [v.detach() for v in values]
            others[at] = value + amount * step * direction
            return float(function(*others).detach())

        truth = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * step)
        found = float((slope * direction).sum())
        assert abs(found - truth) <= rel * max(
            abs(truth), 1e-3 * float((slope * direction).abs().sum())
        )
        assert truth != 0


def check_lens_gradient(geo, names, figure, **options):
    """``check_gradient`` of a figure of a lens to tensors of the lens, by name."""
    names = names.split()

    def function(*values):
        return figure(geo.replace(**dict(zip(names, values, strict=True))))

    check_gradient(function, *(getattr(geo, name) for name in names), **options)


ENDINGS = {"deeplens": "json", "optiland": "json", "native": "json", "table": "txt"}


def plain(text):
    """The text that a table's spelling stands for."""
    text = text.replace(r"\n", "\n").replace(r"\x00", "\0").replace(r"\x01", "\1")
    return re.sub(r"\{([^*{]+)\*(\d+)\}", lambda found: found[1] * int(found[2]), text)


def edited(text, exchanges):
    """A text with the first places of some words exchanged: "old => new ;; old => new"."""
    for exchange in filter(None, exchanges.split(" ;; ")):
        old, new = (plain(side) for side in re.split(r" =>(?: |$)", exchange))
        assert old == "*" or old in text, f"{old!r} is not in the file"
        text = new if old == "*" else text.replace(old, new, 1)
    return text


def _sections():
    """Good files by format, rows (format, exchanges, pattern) of faults and (format, exchanges,
    expression) of facts."""
    files, faults, facts = {}, [], []
    for section in Path(__file__).with_name("files.txt").read_text().split("\n[")[1:]:
        kind, rest = section.split("]\n", 1)
        files[kind], *tables = rest.split("--\n")
        for rows, table in zip((faults, facts), tables, strict=True):
            rows += [
                (kind, *re.split(r" ?\| ", row, maxsplit=1)) for row in table.splitlines() if row
            ]
    return files, faults, facts


FILES, FAULTS, FACTS = _sections()


def load_file(folder, kind, exchanges="", content=None):
    """The lens of a good file after exchanges, or of other content of that format."""
    path = folder / f"lens.{ENDINGS.get(kind, kind)}"
    content = edited(FILES[kind], exchanges) if content is None else content
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return lens.load(path)
