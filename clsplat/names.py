"""Names of files: those that every system can hold, and those of a run folder that no pipeline may choose."""

import re
from pathlib import PureWindowsPath

# What a run or a matrix writes itself, in its folder.
PIPELINE = "pipeline.yaml"
METRICS = "metrics.json"
RECORDS = "metrics.jsonl"
TRIAL = "trial.jsonl"
STATUS = "status.json"
LOG_FILE = "log.txt"
NOTE = "prepared.json"
INPUTS = "inputs.json"
CHECKSUMS = "checksums.json"
LOCK = "run.lock"
CHECKPOINTS = "checkpoints"
UNDISTORTED = "undistorted"
PREPARED = "prepared"
COMPARISON = "compare.html"
SEAMS = "seams"
VIEW_COLOURS = "view_colours.json"
VIEW_GRIDS = "view_colours.npy"
VIEW_POSES = "view_poses.json"
RESERVED = frozenset(
    {
        *(PIPELINE, METRICS, RECORDS, TRIAL, STATUS, LOG_FILE, NOTE, INPUTS, CHECKSUMS, LOCK),
        *(CHECKPOINTS, UNDISTORTED, PREPARED, COMPARISON, SEAMS, "cameras.json", VIEW_COLOURS, VIEW_GRIDS, VIEW_POSES),
    }
)
BEFORE_A_RUN = frozenset({STATUS, LOG_FILE, LOCK, UNDISTORTED})  # written before pipeline.yaml
OF_A_RUN = BEFORE_A_RUN | {PIPELINE, METRICS, RECORDS, TRIAL, NOTE, INPUTS, CHECKSUMS, CHECKPOINTS}
OF_A_MATRIX = frozenset({STATUS, LOCK, PIPELINE, COMPARISON})
END_STATES = ("done", "failed", "interrupted")  # of status.json
SILENT = 60  # seconds without a heartbeat there after which a run may have ended
LONGEST = 200  # bytes; systems allow 255, and temporary names are longer
_DEVICES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³])(\..*)?", re.IGNORECASE)  # of Windows


def fault_of_name(name: str) -> str | None:
    """Return why not every system can hold a file of this name, or None."""
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        return f"{name!r} is not text"
    if size > LONGEST:
        return f"a name has {size} bytes; the limit is {LONGEST}"
    if any(letter < " " or letter in '<>:"|?*\x7f' for letter in name):
        return f"{name!r} holds a character that not every system allows"
    if _DEVICES.fullmatch(name.rstrip(" .")) or re.search(r"~\d", name) or name != name.rstrip(" ."):
        return f"'{name}' means something else on Windows"
    return None


def is_inside(text: str) -> bool:
    """Whether a relative path stays in its folder.  Both kinds of slash separate."""
    path = PureWindowsPath(text)
    return bool(path.parts) and not path.anchor and ".." not in path.parts


def fault_of_output(text: str) -> str | None:
    """Return why a pipeline may not choose a path in the run folder, or None."""
    parts = PureWindowsPath(text).parts
    if not is_inside(text):
        return "it is not inside"
    if parts[0].casefold() in RESERVED:
        return f"'{parts[0]}' is written by the run itself"
    if any(part.startswith(".") for part in parts):
        return "names with a dot in front are for temporary files"
    return next(filter(None, map(fault_of_name, parts)), None)
