"""Report of a reproduction: the paper's tables and figures in order, beside the measured ones."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.figures import Picture
from touchdown.experiments.reporting.flights import check_revisions, frame_of, load_flights
from touchdown.experiments.reporting.published import NETWORK_NAMES, SITES
from touchdown.experiments.reporting.report import (
    Report,
    Section,
    condition_words,
    make_report,
    tiles,
    write_report,
)
from touchdown.experiments.reproduce.items import item_table
from touchdown.experiments.reproduce.networks import PICTURES
from touchdown.experiments.reproduce.plans import PAPER_SCENES
from touchdown.experiments.reproduce.state import PartState, Reproduction
from touchdown.experiments.reproduce.steps import FLIGHTS, PARTS, VEHICLE, Part
from touchdown.experiments.reproduce.tables import (
    calibration_table,
    claim_table,
    network_tables,
    rig_table,
    site_table,
    speed_table,
)

_SECTIONS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "positioning": (
        ("summary", "flights", "accuracy", "axes", "map", "paths"),
        ("fig9a", "fig10"),
    ),
    "commanded_site": (("summary", "landings"), ("fig12",)),
    "zou2024_sites": (("summary", "landings"), ()),
    "zou2024": (("summary", "accuracy", "paths", "landings"), ("fig9b",)),
    "real_sites": (("summary", "landings"), ()),
    "landing": (("summary", "landings"), ()),
}
"""Sections and figures that are copied from the report of each campaign."""

_PICTURES: Mapping[str, tuple[tuple[str, str, str, str], ...]] = {
    "calibration": (
        ("fig2", "Fig. 2: the cloud in the colours of the image",
         "One view of the chessboard from beside the camera: with a correct calibration its "
         "squares lie flat and undistorted on the board.", "cloud.png"),
        ("fig2_boards", "The views of the calibration", "Detected corners.", "boards.png"),
    ),
    "edges": (
        ("fig4", "Fig. 4: edge energy and local smoothness",
         "An image, the energy of its structured edges, f_c of the returns of one scan, and the "
         "edge and planar points selected by it.", "smoothness.jpg"),
    ),
    "world": (
        ("fig7", "Fig. 7: the vehicle",
         "Battery above, LIDAR, camera and computer below; the paper's is a real one.", VEHICLE),
    ),
}  # fmt: skip
"""By part: name, title, caption and file of its pictures."""


def write_reproduction(done: Reproduction, out: Path) -> dict[str, Path]:
    """Writes report.html, report.md, report.json and figures/. Raises UsageError if ``out``
    cannot be written."""
    rows: list[dict[str, Any]] = []
    sections = [
        _section(part, done.states[part.name], done.out / part.name, rows)
        for part in PARTS
        if part.name in done.states
    ]
    sections[:0] = [
        Section("summary", "Summary", _summary_words(done)),
        Section("items", "Items of the paper and their sections here",
                tables=[item_table(done.states)]),
    ]  # fmt: skip
    if rows:
        sections.append(Section("conditions", "Conditions", condition_words(rows)))
    ended = sum(not state.error for state in done.states.values())
    heads = [("parts ended", f"{ended} of {len(PARTS)}"), *(tiles(frame_of(rows)) if rows else [])]
    edition = "quick edition" if done.quick else "whole edition"
    return write_report(
        Report(f"Touchdown: the paper reproduced, {edition}", heads, sections), rows, out
    )


def _summary_words(done: Reproduction) -> list[str]:
    lines = []
    if done.quick:
        lines.append(
            "Quick edition: the first seed of each campaign and not all of its scenes, so most "
            "figures have no interval; a single flight proves little. `touchdown reproduce` "
            "without `--quick` in the same directory flies the rest."
        )
    for part in PARTS:
        state = done.states.get(part.name)
        shows = f" ({', '.join(part.shows)})" if part.shows else ""
        if state is None:
            why = "by `--skip`" if part.name in done.skipped else "not done yet"
            if part.needs_photographs:
                why = "which `--photographs` names images for"
            lines.append(f"`{part.name}`{shows} is left out, {why}.")
        elif state.error:
            lines.append(f"`{part.name}`{shows} ended with an error: {state.error}.")
        elif state.why:
            lines.append(f"`{part.name}`{shows} failed its purpose: {state.why}.")
    return lines


# ---------------------------------------------------------------------------------------- sections


def _section(part: Part, state: PartState, folder: Path, rows: list[dict[str, Any]]) -> Section:
    """Section of a part; the flights of its campaign are added to ``rows``."""
    revision = f"at revision `{state.git_revision}`" if state.git_revision else "of no revision"
    purpose = f"For {', '.join(part.shows)}" if part.shows else "Beside the paper's own system"
    if part.needs_photographs:
        purpose = "Beside the networks of Tables 3 and 4"
    words = [f"{purpose}, by the part `{part.name}`, {state.edition} edition, ended {revision}."]
    if state.why or state.error:
        words.append(f"Not successful: {state.error or state.why}.")
    section = Section(part.name, part.title, words)
    if state.error and not state.figures:
        return section
    if part.name in _SECTIONS:
        _add_campaign(section, folder / FLIGHTS, rows)
        return section
    try:
        section.pictures += [
            raster(name, title, caption, folder / PICTURES / file)
            for name, title, caption, file in _PICTURES.get(part.name, ())
        ]
        if fill := _FILLERS.get(part.name):
            fill(section, state, folder)
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise UsageError(
            f"'{folder / 'part.json'}' lacks figures of its part; delete it, and the part runs "
            "again"
        ) from error
    return section


def _add_campaign(section: Section, flights: Path, rows: list[dict[str, Any]]) -> None:
    try:
        own = load_flights(flights)
    except UsageError as error:
        section.words.append(f"No flights to show: {error}.")
        return
    check_revisions(own, flights)
    rows += own
    keys, pictures = _SECTIONS[section.key]
    for found in make_report(own, title=section.title).sections:
        if found.key in keys:
            section.words += found.words
            section.tables += _renamed(found.tables, section.key)
            # of several conditions, each has its name after that of the figure
            section.pictures += [p for p in found.pictures if p.name.startswith(pictures)]


def _renamed(tables: list[Any], part: str) -> list[Any]:
    return [replace(table, key=f"{part}_{table.key}") for table in tables]


def _fill_calibration(section: Section, state: PartState, _folder: Path) -> None:
    section.tables.append(calibration_table(state.figures))
    section.words.append(
        "Errors are against the simulated camera and LIDAR; the paper prints no errors of its "
        "calibration."
    )


def _fill_world(section: Section, state: PartState, folder: Path) -> None:
    section.tables.append(rig_table(state.figures))
    section.pictures += [
        raster(f"fig8_{scene}", f"Fig. 8: {scene}", "Seed 0, from the south-west.",
               folder / PICTURES / f"{scene}.jpg")
        for scene in PAPER_SCENES
    ]  # fmt: skip


def _fill_sites(section: Section, state: PartState, folder: Path) -> None:
    section.tables.append(site_table(state.figures))
    section.words.append(
        f"Posed survey: the sensors take the planned poses without a flight; the selector is "
        f"`{state.figures['selector']}`."
    )
    section.pictures += [
        raster(f"fig11_{scene}", f"Fig. 11: {scene}",
               "The map in colour, every cost, their sum, the clusters, and the candidates (blue) "
               "with the site (red).", folder / PICTURES / f"site_{scene}.jpg")
        for scene in SITES
    ]  # fmt: skip


def _fill_speed(section: Section, state: PartState, _folder: Path) -> None:
    section.tables.append(speed_table(state.figures))


def _fill_recognition(section: Section, state: PartState, folder: Path) -> None:
    size = state.figures["size"]
    networks, schemes = len(size["networks"]), len(size["labels"])
    section.words.append(
        f"{size['images']} rendered images of {size['pixels']} pixels; networks "
        f"take {size['image_size']} pixels and train for at most {size['epochs']} epochs. "
        "The paper's images are photographs of UC Merced, AID and Places365, 81 970 for validation "
        "and 5000 for the test. Scores here are on other images and not comparable with these."
    )
    if networks < len(NETWORK_NAMES):
        section.words.append(
            f"The paper trains {len(NETWORK_NAMES)} networks under two label schemes; here "
            f"{networks} under {schemes}, small and for few epochs. This checks that training and "
            "evaluation work; it does not measure attainable scores."
        )
    section.tables += network_tables(state.figures["networks"])
    section.pictures.append(
        raster("fig5", "Fig. 5: kinds of ground", "Ten rendered images of each class of D_Land.",
               folder / state.edition / PICTURES / "contact_sheet.png")
    )  # fmt: skip


def _fill_photographs(section: Section, state: PartState, _folder: Path) -> None:
    size, networks = state.figures["size"], state.figures["networks"]
    names = [Path(argument.rpartition("=")[2]).name for argument in size["photographs"]]
    epochs = [one["epochs"] for one in networks]
    converged = sum(one["converged"] for one in networks)
    section.words.append(
        f"Trained and tested on the photographs of {' and '.join(names)} alone, from random "
        f"weights, at {size['image_size']} pixels, until macro F1 on the validation images had not "
        f"risen for {size['patience']} epochs, for {min(epochs)} to {max(epochs)} epochs: "
        f"{converged} of {len(networks)} trainings converged. The paper trains on more images, of "
        "AID and Places365 too, at a size that it does not print."
    )
    section.tables += _renamed([*network_tables(networks), claim_table(networks)], section.key)


_JPEG_QUALITY = 80
_FILLERS: Mapping[str, Callable[[Section, PartState, Path], None]] = {
    "calibration": _fill_calibration,
    "world": _fill_world,
    "sites": _fill_sites,
    "speed": _fill_speed,
    "recognition": _fill_recognition,
    "photographs": _fill_photographs,
}


def raster(name: str, title: str, caption: str, file: Path) -> Picture:
    """Embeds an image file in an SVG, so that a page needs no other file."""
    import cv2

    from touchdown.experiments.io.images import read_picture

    image = read_picture(file)
    height, width = image.shape[:2]
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    data = base64.b64encode(jpeg.tobytes()).decode("ascii")
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{0.75 * width:g}pt" '
        f'height="{0.75 * height:g}pt" viewBox="0 0 {width} {height}">'
        f'<image width="{width}" height="{height}" href="data:image/jpeg;base64,{data}"/></svg>'
    )
    return Picture(name, title, caption, svg)


# -------------------------------------------------------------------------------------------- json


def figures_of(done: Reproduction, report: Path) -> dict[str, Any]:
    """Result of each part and the files of the ``report``, for ``--json``."""
    parts = [
        {
            "part": name,
            "edition": state.edition,
            "good": state.successful,
            "why": state.error or state.why,
            "wall_s": state.wall_s,
            "figures": state.figures,
        }
        for name, state in done.states.items()
    ]
    return {
        "directory": str(done.out),
        "edition": "quick" if done.quick else "whole",
        "good": done.successful,
        "skipped": list(done.skipped),
        "wall_s": done.wall_s,
        "parts": parts,
        "files": {kind: str(report / f"report.{kind}") for kind in ("html", "md", "json")},
    }
