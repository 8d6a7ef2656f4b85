"""What lies in the folder of a recording: event files, flow files, and the text files beside them.
Zip archives are unpacked for as long as they are needed."""

import re
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from codesign.checks import check_path
from codesign.errors import FileFormatError
from codesign.events.files import READERS
from codesign.reading import open_regular, reading

# of several event files of one name the first of these kinds is read: text as the Event-Camera
# Dataset has it, what cameras write, then arrays that somebody made of either
KINDS = (".txt", ".csv", ".h5", ".hdf5", ".aedat4", ".raw", ".dat")
EVENT_SUFFIXES = set(READERS)
FLOW_SUFFIXES = {".flo", ".png", ".npy", ".npz", ".mat", ".txt", ".csv"}
SIDE_FILES = {
    "imu.txt",
    "groundtruth.txt",
    "calib.txt",
    "images.txt",
    "readme.txt",
    "license.txt",
    "timestamps.txt",
    "forward_timestamps.txt",
}
PUBLISHED = (
    "Recordings are published as DSEC at dsec.ifi.uzh.ch, MVSEC at daniilidis-group.github.io/mvsec, and with "
    "events.txt at rpg.ifi.uzh.ch/davis_data.html."
)
FLOW_WORDS = re.compile(r"(flow|truth|^gt|_gt|gt_|^of_|_of$)", re.IGNORECASE)
# of an archive: what deflate can reach; what is unpacked at most
MOST_RATIO = 1040
MOST_BYTES = 40_000_000_000


@contextmanager
def opened(path: str | Path) -> Iterator[Path]:
    """Yield ``path`` itself, or the folder that a zip archive holds, which is removed afterwards.

    Raises: FileFormatError when there is nothing, or the archive is damaged or out of all
      proportion.
    """
    path = check_path(path, "the path of the recording")
    if not path.exists():
        raise FileFormatError(
            f"nothing lies at {path}; give the path of a folder with events.txt, an event file, or a zip archive "
            f"of either. {PUBLISHED}"
        )
    if path.suffix.lower() != ".zip":
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        with open_regular(path) as file, reading(path, "it is no whole zip archive"):
            with zipfile.ZipFile(file) as archive:
                members = [entry for entry in archive.infolist() if not entry.is_dir()]
                size = sum(entry.file_size for entry in members)
                if size > MOST_BYTES or any(
                    entry.file_size > MOST_RATIO * entry.compress_size + 4096 for entry in members
                ):
                    raise FileFormatError(
                        f"{path} would unpack to {size} bytes, more than {MOST_BYTES} or than its own size "
                        "allows; unpack it by hand."
                    )
                # keeps inside the folder whatever the names say
                archive.extractall(folder, members)
        inside = Path(folder)
        while (
            len(entries := [entry for entry in inside.iterdir() if entry.name != "__MACOSX"]) == 1
            and entries[0].is_dir()
        ):
            inside = entries[0]
        yield inside


def natural(path: str | Path) -> list[int | str]:
    """Sort key: names with numbers in order of the numbers."""
    return [
        int(word) if word.isdecimal() else word for word in re.split(r"(\d+)", str(path).lower())
    ]


def event_files(path: Path) -> list[Path]:
    """[event file] of a recording: the file itself; events.* of a folder; otherwise one per packet,
    from the folder or its subfolders, in natural order; of several of one name the first of KINDS.

    Raises: FileFormatError when there is none.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    for folders in (
        [path],
        sorted(
            (
                entry
                for entry in path.iterdir()
                if entry.is_dir() and not FLOW_WORDS.search(entry.name)
            ),
            key=natural,
        ),
    ):
        files = []
        for folder in folders:
            found = sorted(
                (entry for entry in folder.iterdir() if entry.is_file() and _holds_events(entry)),
                key=natural,
            )
            named = [entry for entry in found if entry.stem.lower() == "events"]
            files += _one_of_each_name(named or found)
        if files:
            return files
    raise FileFormatError(
        f"{path} holds no events: no events.txt, no event file by another name "
        f"({', '.join(sorted(EVENT_SUFFIXES))}), and no subfolder with one."
    )


def passed_over(file: Path) -> list[Path]:
    """Other event files of the same name beside one, which event_files passes over."""
    same = (
        entry for entry in file.parent.iterdir() if entry != file and _stem(entry) == _stem(file)
    )
    return sorted(
        (entry for entry in same if entry.is_file() and _holds_events(entry)), key=natural
    )


def _stem(entry):
    return entry.stem.lower()


def _one_of_each_name(files):
    best = {_stem(entry): entry for entry in sorted(files, key=_rank, reverse=True)}
    return [entry for entry in files if best[_stem(entry)] == entry]


def _rank(entry):
    suffix = entry.suffix.lower()
    return KINDS.index(suffix) if suffix in KINDS else len(KINDS), entry.name


def flow_files(folder: Path) -> list[Path]:
    """[flow file] of a folder that holds nothing else of these kinds, in natural order;
    flow/forward inside where there is one."""
    folder = Path(folder)
    for inside in (folder / "flow" / "forward", folder / "forward", folder / "flow", folder):
        if inside.is_dir():
            files = [entry for entry in inside.iterdir() if _may_hold_flow(entry)]
            named = [entry for entry in files if _is_named_flow(entry)]
            chosen = (
                files
                if inside != folder and not named
                else named
                or [
                    entry
                    for entry in files
                    if entry.suffix.lower() in (".png", ".npy", ".npz", ".mat")
                ]
            )
            if chosen:
                return sorted(_one_kind(chosen), key=natural)
    raise FileFormatError(f"{folder} holds no flow files ({', '.join(sorted(FLOW_SUFFIXES))}).")


def truth_beside(events: Path, alone: bool) -> Path | None:
    """The flow file that lies beside a packet's event file: its name with flow or truth in it, or
    the same number; None when there is none.

    Args:
      events: path of the event file.
      alone: it is the only one of its folder.
    """
    beside = sorted(events.parent.iterdir(), key=natural)
    named = [
        entry
        for entry in beside
        if entry != events and _may_hold_flow(entry) and _is_named_flow(entry)
    ]
    if not alone:
        numbers = re.findall(r"\d+", events.stem)
        named = [
            entry
            for entry in named
            if (
                numbers
                and [int(n) for n in re.findall(r"\d+", entry.stem)] == [int(n) for n in numbers]
            )
            or entry.stem.startswith(events.stem)
        ]
    return _one_kind(named)[0] if named else None


def truth_folder(events: Path) -> Path | None:
    """The folder of flow files beside an event file or beside its folder; None when there is
    none."""
    for place in (events.parent, events.parent.parent):
        for entry in sorted(
            (
                entry
                for entry in place.iterdir()
                if entry.is_dir() and FLOW_WORDS.search(entry.name)
            ),
            key=natural,
        ):
            if any(map(_may_hold_flow, entry.rglob("*"))):
                return entry
    return None


def side_file(events: Path, name: str) -> Path | None:
    """A file such as imu.txt in the folder of an event file, or in the one above; None when there
    is none."""
    return next(
        (
            folder / name
            for folder in (events.parent, events.parent.parent)
            if (folder / name).is_file()
        ),
        None,
    )


def _may_hold_flow(entry):
    suffix = entry.suffix.lower()
    return entry.is_file() and suffix in FLOW_SUFFIXES and entry.name.lower() not in SIDE_FILES


def _is_named_flow(entry):
    return bool(FLOW_WORDS.search(entry.stem)) or entry.suffix.lower() == ".flo"


def _holds_events(entry):
    return (
        entry.suffix.lower() in EVENT_SUFFIXES
        and entry.name.lower() not in SIDE_FILES
        and not FLOW_WORDS.search(entry.stem)
    )


def _one_kind(files):
    """The exact kind where the same flow lies there twice (.flo before .png)."""
    kinds = {entry.suffix.lower() for entry in files}
    kind = next(
        kind for kind in (".flo", ".npz", ".npy", ".mat", ".png", ".txt", ".csv") if kind in kinds
    )
    return [entry for entry in files if entry.suffix.lower() == kind]
