"""The files that a mesh file names: read from one folder alone, and told when they are missing."""

import io
import urllib.parse
from pathlib import Path

import PIL.Image

from codesign.errors import FileFormatError
from codesign.reading import read_bytes

DATA = (".mtl", ".bin", "")  # what is no picture
MOST_BYTES = 1 << 30  # of a file


class Folder:
    """What trimesh asks for the files that a mesh names.

    Args:
      mesh: path of the mesh file.
      root: the folder that named files must lie in; None is that of the mesh.
    ``check`` raises for whatever was asked for and could not be given, since trimesh goes on
    without it.
    """

    def __init__(self, mesh: Path, root: str | Path | None = None):
        self.mesh = mesh
        self.parent = mesh.resolve().parent
        self.root = self.parent if root is None else Path(root).resolve()
        self.file_name = mesh.name  # trimesh names meshes without a name by it
        self.given: dict[str, bytes] = {}
        self.missing: list[str] = []

    def get(self, name: str) -> bytes:
        """Bytes of a named file. Raises: FileFormatError when it is elsewhere, missing or no
        picture."""
        if name in self.given:
            return self.given[name]
        try:
            data = read_bytes(self._found(name), MOST_BYTES)
            if Path(name).suffix.lower() not in DATA:
                _check_picture(data, name)
        except FileFormatError as error:
            self.missing.append(str(error))
            raise
        return data

    __getitem__ = get

    def check(self) -> None:
        """Raise FileFormatError when a file that was asked for could not be given."""
        if self.missing:
            told = "; ".join(dict.fromkeys(self.missing))
            raise FileFormatError(
                f"mesh '{self.mesh}' names files that cannot be read: {told}. Put them there, or give radiance= to leave "
                "materials and pictures out."
            )

    def _found(self, name):
        plain = name.strip().strip('"').replace("\\", "/").removeprefix("file://")
        if "://" in plain:
            raise FileFormatError(f"'{name}' lies on a network, from which nothing is read")
        for candidate in dict.fromkeys((plain, urllib.parse.unquote(plain))):
            path = (self.parent / candidate).resolve()
            if not path.is_relative_to(self.root):
                raise FileFormatError(
                    f"'{name}' lies outside '{self.root}' (root= names another folder)"
                )
            if path.is_file():
                return path
        raise FileFormatError(f"'{name}' is missing")


def _check_picture(data, name):
    try:
        with PIL.Image.open(io.BytesIO(data)) as image:
            image.load()
    except (OSError, ValueError, SyntaxError, PIL.Image.DecompressionBombError) as error:
        raise FileFormatError(f"'{name}' is not a readable picture ({str(error)[:60]})") from error
