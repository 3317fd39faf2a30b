"""Export of a finished run in another format."""

from pathlib import Path

from touchdown.experiments.errors import UsageError
from touchdown.experiments.export.datasets import write_euroc, write_kitti
from touchdown.experiments.export.flown_run import (
    LIBRARY,
    Exported,
    ExportOptions,
    FlownRun,
    open_flown,
)
from touchdown.experiments.export.plans import write_plan
from touchdown.experiments.export.point_cloud import write_cloud
from touchdown.experiments.export.ros2_bag import WRITTEN_BY, write_bag
from touchdown.experiments.export.tables import TIME, write_csv, write_tum
from touchdown.experiments.io.run_directory import (
    RUN_FILES,
    unknown_entries,
    whole_file,
    whole_folder,
)
from touchdown.experiments.io.sensor_log_reader import damage_reported

BAG_METADATA = "metadata.yaml"
WRITERS = {
    "mcap": write_bag, "ply": write_cloud, "tum": write_tum, "csv": write_csv,
    "euroc": write_euroc, "kitti": write_kitti, "plan": write_plan,
}  # fmt: skip
FOLDERS = ("mcap", "euroc", "kitti")


def export(run: Path, kind: str, out: Path | None, options: ExportOptions) -> Exported:
    """Writes ``run`` as one file of format ``kind`` (mcap, euroc, kitti: one folder), whole or not
    at all; an earlier file or bag of that name is replaced, an earlier folder of a data set is not.

    ``out``: by default beside the run directory. Raises UsageError before anything is written if
    ``run`` is no run directory or lacks what the format needs, or if ``out`` is something else.
    """
    flown = open_flown(run)
    if out is None:
        named = run if run.name not in ("", "..") else run.resolve()
        endings = {"mcap": "-bag", "tum": f"-{options.poses}.tum"}
        ending = endings.get(kind, f"-{kind}" if kind in FOLDERS else f".{kind}")
        out = named.with_name(f"{named.name}{ending}")
    check_out_file(out, kind, run)
    _check_inputs(flown, kind, options)
    try:
        own = _bag_files(out) if kind == "mcap" else ()
        making = whole_folder(out, own) if kind in FOLDERS else whole_file(out)
        with making as partial, damage_reported(_source(flown, kind, options)):
            done = WRITERS[kind](flown, partial, options)
    except OSError as error:
        raise UsageError(f"--out {out}: cannot be written: {error.strerror or error}") from error
    done.out = out
    files = [out] if out.is_file() else out.rglob("*")
    done.facts["bytes"] = sum(file.stat().st_size for file in files if file.is_file())
    return done


def _source(flown: FlownRun, kind: str, options: ExportOptions) -> Path:
    """The source of an export, to be named where it is damaged."""
    logged = kind in FOLDERS or (kind == "ply" and options.points == "scans")
    return flown.sensors() if logged else flown.path


def _check_inputs(flown: FlownRun, kind: str, options: ExportOptions) -> None:
    """Raises UsageError where the run lacks what the format needs."""
    if kind == "ply" and options.points == "map":
        flown.file("map.ply")
        return
    if kind in (*FOLDERS, "ply"):
        flown.sensors()
    names = {"mcap": ("truth", "estimate"), "csv": ("truth",), "euroc": ("truth",),
             "kitti": ("truth", options.poses),
             "plan": ("truth",)}.get(kind, (options.poses,))  # fmt: skip
    for name in names:
        flown.file(f"{name}.tum")


def check_out_file(out: Path, kind: str, run: Path) -> None:
    """Raises UsageError unless ``out`` is new or an earlier export of that kind."""
    if out.name in RUN_FILES and out.resolve().parent == run.resolve():
        raise UsageError(f"--out {out}: is a file of the run itself; name another file")
    if kind in FOLDERS and out.is_file():
        raise UsageError(f"--out {out}: is a file; a bag or data set is a folder")
    if kind in FOLDERS[1:] and out.exists() and any(out.iterdir()):
        raise UsageError(f"--out {out}: is a folder that holds something; name a new one")
    if kind not in FOLDERS and out.is_dir():
        raise UsageError(f"--out {out}: is a directory; name a file")
    if out.exists() and not _is_export(out, kind):
        raise UsageError(
            f"--out {out}: holds something that is no earlier export; choose another name"
        )


def _is_export(path: Path, kind: str) -> bool:
    try:
        if kind in FOLDERS:
            return not any(path.iterdir()) or _is_our_bag(path)
        with path.open("rb") as file:
            head = file.read(400)
    except OSError as error:
        raise UsageError(f"--out {path}: cannot be read: {error.strerror}") from error
    if kind == "ply":
        return head.startswith(b"ply\n") and f"comment {LIBRARY}".encode() in head
    if kind == "plan":
        return b'"fileType": "Plan"' in head
    if kind == "csv":
        return head.startswith(f"{TIME},phase,judged".encode())
    try:
        return len([float(word) for word in head.partition(b"\n")[0].split()]) == 8
    except ValueError:
        return False


def _bag_files(folder: Path) -> tuple[str, str]:
    return BAG_METADATA, f"{folder.name}.mcap"


def _is_our_bag(folder: Path) -> bool:
    if unknown_entries(folder, _bag_files(folder)):
        return False  # it would go with the bag
    metadata = folder / BAG_METADATA
    text = metadata.read_text(encoding="utf-8", errors="replace") if metadata.is_file() else ""
    return f"{WRITTEN_BY}: {LIBRARY}" in text
