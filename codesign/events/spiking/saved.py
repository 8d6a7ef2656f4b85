"""A trained generator as a file: an .npz of its parameters and, as JSON, its settings."""

import io
import json

import numpy as np
import torch

from codesign.atomic import write_atomic
from codesign.errors import FileFormatError
from codesign.reading import open_regular, reading

SETTINGS = "settings"
MOST_BYTES = 10**9


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
    with open_regular(path, MOST_BYTES) as file, reading(f"the generator {path}", remedy):
        with np.load(file, allow_pickle=False) as data:
            settings = json.loads(str(data[SETTINGS]))
            parameters = {name: torch.from_numpy(data[name]) for name in data.files if name != SETTINGS}
        generator = kind(**settings)
        generator.load_state_dict(parameters)
    for name, value in parameters.items():
        if not bool(value.isfinite().all()):
            raise FileFormatError(
                f"'{path}' holds NaN or infinity in '{name}'; train and save the generator again."
            )
    return generator
