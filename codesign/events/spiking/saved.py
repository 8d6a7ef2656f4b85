"""A trained generator as a file: an .npz of its parameters and, as JSON, its settings."""

import io
import json

import numpy as np
import torch

from codesign.arrays import read_npz
from codesign.atomic import write_atomic
from codesign.errors import CodesignError, FileFormatError
from codesign.reading import reading

SETTINGS = "settings"


def write_generator(path, settings, parameters):
    """Write settings (plain numbers and names) and parameters (name -> tensor) to ``path``."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        **{SETTINGS: np.array(json.dumps(settings))},
        **{name: value.detach().cpu().numpy() for name, value in parameters.items()},
    )
    write_atomic(path, buffer.getvalue())


def read_generator(path, kind):
    """A generator of class ``kind`` with the settings and parameters of a file.

    Raises: FileFormatError when the file is missing, damaged, or holds other parameters than the settings ask
      for.
    """
    remedy = "give the .npz file that SpikeEsim.save wrote"
    stored = read_npz(path, remedy)
    with reading(f"'{path}'", remedy):
        settings = json.loads(str(stored.pop(SETTINGS)))
        parameters = {name: torch.from_numpy(values) for name, values in stored.items()}
    try:
        with reading(f"'{path}'", remedy):
            generator = kind(**settings)
            generator.load_state_dict(parameters)
    except CodesignError as error:
        raise FileFormatError(f"'{path}' holds no generator ({error}); {remedy}.") from error
    for name, value in parameters.items():
        if not bool(value.isfinite().all()):
            raise FileFormatError(
                f"'{path}' holds NaN or infinity in '{name}'; train and save the generator again."
            )
    return generator
