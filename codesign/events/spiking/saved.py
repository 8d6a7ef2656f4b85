"""A trained generator as a file: an .npz of its parameters and, as JSON, its settings."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import torch

from codesign.errors import CodesignError, FileFormatError

SETTINGS = "settings"


def write_generator(path, settings, parameters):
    """Write settings (plain numbers and names) and parameters (name -> tensor) to ``path``."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        **{SETTINGS: np.array(json.dumps(settings))},
        **{name: value.detach().cpu().numpy() for name, value in parameters.items()},
    )
    Path(path).write_bytes(buffer.getvalue())


def read_generator(path, kind):
    """A generator of class ``kind`` with the settings and parameters of a file.

    Raises: FileFormatError when the file is missing, damaged, or holds other parameters than the settings ask
      for.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(
            f"the generator '{path}' is not there; give the .npz file that SpikeEsim.save wrote."
        )
    try:
        with np.load(path, allow_pickle=False) as data:
            settings = json.loads(str(data[SETTINGS]))
            parameters = {name: torch.from_numpy(data[name]) for name in data.files if name != SETTINGS}
        generator = kind(**settings)
        generator.load_state_dict(parameters)
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        RuntimeError,
        zipfile.BadZipFile,
        CodesignError,
    ) as error:
        reason = " ".join(str(error).split())
        raise FileFormatError(
            f"'{path}' holds no generator ({reason[:120]}); give the .npz file that SpikeEsim.save wrote."
        ) from error
    for name, value in parameters.items():
        if not bool(value.isfinite().all()):
            raise FileFormatError(
                f"'{path}' holds NaN or infinity in '{name}'; train and save the generator again."
            )
    return generator
