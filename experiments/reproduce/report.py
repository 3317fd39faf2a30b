"""Report of a reproduction: the paper's tables and figures in order, beside the measured ones."""

import base64
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from touchdown.experiments.errors import UsageError
from touchdown.experiments.reporting.figures import Picture
from touchdown.experiments.reporting.flights import check_revisions, load_flights
from touchdown.experiments.reporting.published import NETWORK_NAMES, SITES
from touchdown.experiments.reporting.report import (
    Report,
    Section,
    condition_words,
    make_report,
    write_report,
)
from touchdown.experiments.reporting.tables import MISSING, Cell, Table
from touchdown.experiments.reproduce.networks import PICTURES
from touchdown.experiments.reproduce.parts import (
    FLIGHTS,
    PAPER_SCENES,
    PARTS,
    VEHICLE,
    Part,
    PartResult,
    Reproduction,
)
from touchdown.experiments.reproduce.tables import (
    calibration_table,
    claim_table,
    network_tables,
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
        _section(part, done.results[part.name], done.out / part.name, rows)
        for part in PARTS
        if part.name in done.results
    ]
    sections[:0] = [
        Section("summary", "Summary", _summary_words(done)),
        Section("items", "Items of the paper and their sections here",
                tables=[item_table(done.results)]),
    ]  # fmt: skip
    if rows:
        sections.append(Section("conditions", "Conditions", condition_words(rows)))
    edition = "quick edition" if done.quick else "whole edition"
    return write_report(
        Report(f"Touchdown: the paper reproduced, {edition}", sections, paper=True), rows, out
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
        shows = f" ({', '.join(part.shows)})" if part.shows else ""
        if (result := done.results.get(part.name)) is None:
            lines.append(f"`{part.name}`{shows} is left out.")
        elif result.failure:
            lines.append(f"`{part.name}`{shows} failed: {result.failure}.")
    return lines


def _section(part: Part, result: PartResult, folder: Path, rows: list[dict[str, Any]]) -> Section:
    """Section of a part; the flights of its campaign are added to ``rows``."""
    revision = f"at revision `{result.git_revision}`" if result.git_revision else "of no revision"
    purpose = f"For {', '.join(part.shows)}" if part.shows else "Beside the paper's own system"
    if part.needs_photographs:
        purpose = "Beside the networks of Tables 3 and 4"
    words = [f"{purpose}, by the part `{part.name}`, {result.edition} edition, ended {revision}."]
    if result.failure:
        words.append(f"Not successful: {result.failure}.")
    section = Section(part.name, part.title, words)
    if result.error and not result.figures:
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
            fill(section, result, folder)
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
    for found in make_report(own, title=section.title, paper=True).sections:
        if found.key in keys:
            section.words += found.words
            section.tables += _renamed(found.tables, section.key)
            # of several conditions, each has its name after that of the figure
            section.pictures += [p for p in found.pictures if p.name.startswith(pictures)]


def _renamed(tables: list[Any], part: str) -> list[Any]:
    return [replace(table, key=f"{part}_{table.key}") for table in tables]


def _fill_world(section: Section, _result: PartResult, folder: Path) -> None:
    section.pictures += [
        raster(f"fig8_{scene}", f"Fig. 8: {scene}", "Seed 0, from the south-west.",
               folder / PICTURES / f"{scene}.jpg")
        for scene in PAPER_SCENES
    ]  # fmt: skip


def _fill_sites(section: Section, result: PartResult, folder: Path) -> None:
    section.tables.append(site_table(result.figures))
    section.words.append(
        f"Posed survey: the sensors take the planned poses without a flight; the selector is "
        f"`{result.figures['selector']}`."
    )
    section.pictures += [
        raster(f"fig11_{scene}", f"Fig. 11: {scene}",
               "The map in colour, every cost, their sum, the clusters, and the candidates (blue) "
               "with the site (red).", folder / PICTURES / f"site_{scene}.jpg")
        for scene in SITES
    ]  # fmt: skip


def _fill_recognition(section: Section, result: PartResult, folder: Path) -> None:
    size = result.figures["size"]
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
    section.tables += network_tables(result.figures["networks"])
    section.pictures.append(
        raster("fig5", "Fig. 5: kinds of ground", "Ten rendered images of each class of D_Land.",
               folder / result.edition / PICTURES / "contact_sheet.png")
    )  # fmt: skip


def _fill_photographs(section: Section, result: PartResult, _folder: Path) -> None:
    size, networks = result.figures["size"], result.figures["networks"]
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
_FILLERS: Mapping[str, Callable[[Section, PartResult, Path], None]] = {
    "calibration": lambda section, result, _folder: section.tables.append(
        calibration_table(result.figures)
    ),
    "world": _fill_world,
    "sites": _fill_sites,
    "speed": lambda section, result, _folder: section.tables.append(speed_table(result.figures)),
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


_WITHOUT_NUMBERS = "no: the paper prints it without numbers, of other scenes"
_OTHER_IMAGES = "no: trained and tested on other images than the paper's"
_V_Z = "v_z is set by `landing.touchdown_speed_mps`"


@dataclass(frozen=True, slots=True)
class Item:
    """A table or figure of the paper. ``comparable``: its figures with the paper's, in part or not,
    and why; ``measured``: False for a drawing; ``settings``: its figures that the configuration
    sets."""

    name: str
    content: str
    comparable: str
    measured: bool = True
    settings: str = ""


ITEMS: tuple[Item, ...] = (
    Item("Fig. 2", "a coloured cloud of camera and LIDAR",
         "no: the paper prints no errors of its calibration"),
    Item("Fig. 4", "edge energy of an image, and smoothness of the returns by it",
         _WITHOUT_NUMBERS, measured=False),
    Item("Fig. 5", "images of the kinds of ground", "no: rendered images, not the paper's",
         measured=False),
    Item("Fig. 7", "the vehicle", "no: a model, not the paper's vehicle", measured=False),
    Item("Fig. 8", "the simulated vehicle and four scenes", "no: other scenes", measured=False),
    Item("Table 1", "scan time, density and levelness of the maps",
         "in part: levelness of other scenes, and the paper does not define its ±; its T_total and "
         "ρ_map cannot be told apart", settings="T_total is set by `survey.duration_s`"),
    Item("Fig. 9 a", "trajectories of surveys", _WITHOUT_NUMBERS),
    Item("Table 2", "mean and variance of the deviation from the path, by method",
         "in part: the same measure over another crossroad scene in another simulator, without "
         "`gps`", settings="the error of `gps` is set by `gps.preset`"),
    Item("Fig. 10", "paths by method, and errors by axis", _WITHOUT_NUMBERS),
    Item("Fig. 9 b", "trajectories of landings", _WITHOUT_NUMBERS),
    Item("Table 3", "scores of networks under two label schemes", _OTHER_IMAGES),
    Item("Table 4", "cost of networks, and scores on the test images",
         f"{_OTHER_IMAGES}; times on another processor"),
    Item("Table 5", "landings on a designated spot, by method",
         "in part: d_L, a_z and α_L of simulated flights; the paper's are five of a real vehicle",
         settings=_V_Z),
    Item("Fig. 12", "touchdown points", _WITHOUT_NUMBERS),
    Item("Fig. 11", "the steps to a site on five kinds of sites", _WITHOUT_NUMBERS),
    Item("Table 6", "landings on five kinds of sites",
         "in part: sites made to be alike; the paper's are real places", settings=_V_Z),
    Item("Table 7", "time of each step of site selection",
         "in part: the same steps on another processor and another map"),
)  # fmt: skip
"""Tables and figures of the paper by part; its Figs. 1, 3 and 6 are concept drawings."""


def measured(item: Item, result: PartResult | None) -> str:
    """ "yes", or how far not and why: what was measured by the part that shows ``item``; ``result``
    is None where it was left out."""
    if result is None:
        return "no: its part was left out"
    if result.error:
        return f"no: its part ended with an error, {result.error}"
    if not item.measured:
        return "no: a drawing, nothing to measure"
    quick = "quick edition, one seed of few scenes" * (result.edition == "quick")
    lacking = [text for text in (item.settings, quick, result.why) if text]
    return f"in part: {'; '.join(lacking)}" if lacking else "yes"


def item_table(results: Mapping[str, PartResult]) -> Table:
    """A line for each item of the paper: where it is, and how far it is measured and comparable."""
    rows = []
    for item in ITEMS:
        part = next(part for part in PARTS if item.name in part.shows)
        own = measured(item, results.get(part.name))
        beside = "no: not measured" if own.startswith("no") and item.measured else item.comparable
        where = part.title if part.name in results else MISSING
        texts = (item.name, item.content, where, own, beside)
        rows.append([Cell(text, kind="name") for text in texts])
    header = ["item of the paper", "content", "section here", "measured",
              "comparable with the paper"]  # fmt: skip
    notes = ["Figs. 1, 3 and 6 of the paper are concept drawings; they hold nothing to measure."]
    return Table("items", "Item by item", header, rows, notes)
