"""Records whose fields are columns: a row in each for every ray, point or edge."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, ClassVar, Self

import numpy as np
import torch


class Rows:
    """Base of dataclasses all of whose fields are tensors or arrays with equally many rows."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __getitem__(self, rows: Any) -> Self:
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, of which there is at least one, one part after the other."""
        columns = ([getattr(part, field.name) for part in parts] for field in fields(cls))
        return cls(*(torch.cat(c) if torch.is_tensor(c[0]) else np.concatenate(c) for c in columns))
