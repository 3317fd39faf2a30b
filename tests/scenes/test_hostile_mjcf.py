"""Untrusted MJCF files: each is refused in one line that names the limit, or read without harm."""

import re
import struct
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.scenes.compose import load_scene
from touchdown.scenes.importers import model_check
from touchdown.sim.files import child

from support.hostile_files import limited, pipe, png, sparse
from support.places import load_quietly

FLOOR = '<geom name="lawn" type="plane" size="100 100 1"/>'
TEXTURE = '<asset><texture name="t" type="2d" {}/><material name="m" texture="t"/></asset>'
FIELD = '<asset><hfield name="h" size="9 9 1 1" {}/></asset>'
MESH = '<asset><mesh name="h" {}/></asset>'
MODEL = '<asset><model name="q" file="{}"/></asset>'
ON_FIELD, ON_MESH = '<geom type="hfield" hfield="h"/>', '<geom type="mesh" mesh="h"/>'
ATTACH = '<attach model="q" prefix="p"/>'
BOWL = '<extension><plugin plugin="mujoco.sdf.bowl"><instance name="b"/></plugin></extension>'
TIME, MEMORY = "needs more than 2 s of a processor to compile it", "GiB of memory to compile it"


@pytest.fixture(autouse=True)
def _nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """The error is one line, whatever MuJoCo's readers say besides."""
    yield
    assert not capfd.readouterr().err


@pytest.fixture
def _little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits that small files meet."""
    few = {kind: (100, "leave some out") for kind in model_check.MAX_ELEMENTS}
    for module, name, maximum in (
        (child, "CPU_S", 2), (model_check, "MAX_ELEMENTS", few), (model_check, "MAX_FILES", 3),
        (model_check, "MAX_CELLS", 3000), (model_check, "MAX_TEXELS", 70_000),
        (model_check, "MAX_TRIANGLES", 5000), (model_check, "MAX_TEXT_BYTES", 1 << 20),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, maximum)


def place(body: str = "", head: str = "", before: str = "") -> str:
    return f"{before}<mujoco>{head}<worldbody>{FLOOR}{body}</worldbody></mujoco>"


def replicas(count: int, inner: str) -> str:
    return f'<replicate count="{count}" offset="1 0 0">{inner}</replicate>'


def load(folder: Path, text: str) -> Scene:
    (folder / "place.xml").write_text(text)
    return load_quietly(folder / "place.xml")


def refused(folder: Path, text: str | bytes, message: str) -> None:
    data = text.encode() if isinstance(text, str) else text
    (folder / "place.xml").write_bytes(data)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with pytest.raises(ValueError, match=message) as caught:
            load_scene(str(folder / "place.xml"), 0)
    assert "\n" not in str(caught.value) and not said


@pytest.mark.usefixtures("_little")
@pytest.mark.parametrize(("text", "message"), [
    (place(ON_FIELD, FIELD.format('nrow="100000" ncol="100000"')), f"4 {MEMORY}; simplify its"),
    (place(ON_FIELD, FIELD.format('nrow="60" ncol="60"')), "'h' has 60 x 60 cells, more than 3000"),
    (place("", TEXTURE.format('builtin="flat" width="20000" height="2"')),
     "texture 't' has 20000 x 2 pixels, more than 16384 along a side"),
    (place("", TEXTURE.format('builtin="flat" width="300" height="300"')),
     "70000 with all others together; make it coar"),
    (place(replicas(10**9, '<geom size=".1"/>')), f"{TIME}|{MEMORY}"),
    (place(replicas(11, replicas(10, '<geom size=".1"/>'))), "111 geoms, more than 100; leave"),
    (place('<flexcomp type="grid" count="2000 2000 200" spacing="1 1 1" name="f" dim="3"/>'),
     f"{TIME}|{MEMORY}|100000"),
    (place('<body><joint/><geom size="1"/></body>' * 99 + '<geom size="1"/>'), "101 geoms"),
    (place().replace("</mujoco>", f"<sensor>{'<clock/>' * 101}</sensor></mujoco>"), "101 sensors"),
    (place("<body>" * 600 + '<geom size="1"/>' + "</body>" * 600), "nesting is too deep"),
    (place(ON_MESH, MESH.format('builtin="supersphere" params="20000 .5 .5"')), f"{TIME}|{MEMORY}"),
    (place(ON_FIELD * 3, FIELD.format('nrow="32" ncol="32"')), "have 6144 triangles, more than 50"),
    (place('<geom type="sdf" mesh="b"><plugin instance="b"/></geom>', BOWL), "plug-in|mesh"),
    (place('<geom type="mesh" mesh="b"/>',
           f'{BOWL}<asset><mesh name="b"><plugin instance="b"/></mesh></asset>'), "plug-in 'b'"),
    (place('<geom type="hfield" hfield="line"/>',
           '<asset><hfield name="line" nrow="1" ncol="9" size="1 1 1 1"/></asset>'),
     "height field 'line' has fewer than 2 rows"),
    ('<robot name="r"><link name="a"/></robot>', "no ground under the take-off spot"),
    ("<mujoco><worldbody></mujoco>", "not a valid MJCF file: XML parse error"),
    (place("<!-- größe -->").encode("latin-1"), "is not UTF-8 text .byte .*; save it as UTF-8"),
    (place('<geom name="[/x]" size="1" pos="1e300 0 0"/>'), r"geom '\[/x\]' lies or reaches"),
    (place('<geom size="1" pos="nan 0 0"/>'), "geom .* NaN or infinite"),
    (place('<body pos="inf 0 0"><geom size="1"/></body>'), "NaN or infinite"),
    (place('<geom size="inf"/>'), "NaN or infinite"),
    (place('<geom size="1e30"/>'), "farther than 1e\\+08 m"),
    (place('<geom size="1" friction="nan 0 0"/>'), "NaN or infinite .geom_friction"),
    (place(ON_FIELD, FIELD.format('nrow="2" ncol="2" elevation="0 0 nan 0"')),
     "height field 'h' has a number that is NaN"),
    ("<mujoco>" + " " * (2 << 20), "place.xml has 2 MiB, and .* may have 1 MiB"),
])  # fmt: skip
def test_what_a_file_declares_is_limited(tmp_path: Path, text: str | bytes, message: str) -> None:
    refused(tmp_path, text, message)


@pytest.mark.usefixtures("_little")
@pytest.mark.parametrize(("files", "text", "message"), [
    ({"t.png": png(20_000, 2, inflated=2 * 60_001)}, place("", TEXTURE.format('file="t.png"')),
     "20000 x 2 pixels"),
    ({"t.png": png(300, 300, inflated=300 * 901)}, place("", TEXTURE.format('file="t.png"')),
     "300 x 300 pixels"),
    ({"d/t.png": png(300, 300, inflated=300 * 901)},
     place("", '<compiler texturedir="d" strippath="true"/>' + TEXTURE.format('file="x/t.png"')),
     "300 x 300 pixels"),
    ({"t.png": png(30_000, 30_000)}, place("", TEXTURE.format('file="t.png"')),
     f"error|{TIME}|{MEMORY}"),
    ({"h.png": png(60, 60, 8, 0, inflated=60 * 61)}, place(ON_FIELD, FIELD.format('file="h.png"')),
     "60 x 60 cells"),
    ({"h.bin": struct.pack("<ii", 100_000, 100_000)}, place(ON_FIELD, FIELD.format('file="h.bin"')),
     "not a valid MJCF file|memory"),
    ({"a.xml": " " * (2 << 20)}, place("", '<include file="a.xml"/>'), "2 MiB, and .* 1 MiB"),
    ({}, place("", '<include file="place.xml"/>'), "not a valid MJCF file|ends the process"),
    ({"a.xml": '<mujoco><include file="place.xml"/></mujoco>'},
     place("", '<include file="a.xml"/>'), "not a valid MJCF file|ends the process"),
    ({}, place(ATTACH, MODEL.format("place.xml")), f"not a valid|ends the process|{TIME}|{MEMORY}"),
    ({"a.xml": place('<geom size="1"/>' * 9)},
     place(replicas(20, ATTACH), MODEL.format("a.xml")), "it has 2.. geoms, more than 100"),
    ({f"{n}.xml": "<mujoco/>" for n in range(4)},
     place("", "".join(f'<include file="{n}.xml"/>' for n in range(4))), "more than 3 files; join"),
    ({"m.obj": "v 0 0 0\nv 4 0 0\nv 0 4 0\nv 0 0 2\nv 1e400 0 0\nf 1 2 4\nf 2 3 4\nf 5 1 4\n"},
     place(ON_MESH, MESH.format('file="m.obj"')), "is flat"),
])  # fmt: skip
def test_what_its_files_hold_is_limited(
    tmp_path: Path, files: dict[str, str | bytes], text: str, message: str
) -> None:
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    refused(tmp_path, text, message)


@pytest.mark.parametrize(("head", "body"), [
    (MESH.format('file="{}.obj"'), ON_MESH),
    ('<compiler meshdir="sub"/>' + MESH.format('file="../{}.obj"'), ON_MESH),
    (TEXTURE.format('file="{}.png"'), ""),
    (FIELD.format('file="{}.bin"'), ON_FIELD),
    ('<include file="{}.xml"/>', ""),
    (MODEL.format("{}.xml"), ""),
    ('<deformable><skin name="s" file="{}.skn"/></deformable>', ""),
])  # fmt: skip
@pytest.mark.parametrize("kind", ["named pipe", "directory", "device"])
def test_what_is_no_file_is_not_opened(tmp_path: Path, head: str, body: str, kind: str) -> None:
    (tmp_path / "sub").mkdir()
    for ending in ("obj", "png", "bin", "xml", "skn"):
        target = tmp_path / f"a.{ending}"
        makers: dict[str, Callable[[], object]] = {
            "named pipe": lambda target=target: pipe(target), "directory": target.mkdir,
            "device": lambda target=target: target.symlink_to("/dev/zero"),
        }  # fmt: skip
        makers[kind]()
    refused(tmp_path, place(body, head.format("a")), f"is a {kind}; give a file")


def test_a_scene_that_is_no_file(tmp_path: Path) -> None:
    for path, word in ((pipe(tmp_path / "p.xml"), "named pipe"), (tmp_path, "directory")):
        with pytest.raises(ValueError, match=f"a scene '.*' is a {word}; give a file"):
            load_scene(f"{path}/" if path == tmp_path else str(path), 0)


def test_a_mesh_that_takes_too_long_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time of a convex hull follows from the shape: every point is part of it here."""
    monkeypatch.setattr(child, "CPU_S", 1)
    found = np.random.default_rng(0).standard_normal((150_000, 3))
    found *= 10.0 / np.linalg.norm(found, axis=1)[:, None]
    lines = [f"v {x} {y} {z}" for x, y, z in found]
    lines += [f"f {i} {i + 1} {i + 2}" for i in range(1, len(found) - 1, 3)]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    refused(tmp_path, place(ON_MESH, MESH.format('file="ball.obj"')),
            "needs more than 1 s of a processor to compile it; simplify its meshes")  # fmt: skip


def test_entities_are_not_expanded(tmp_path: Path) -> None:
    text = place('<geom name="&a;" size="1"/>', before='<!DOCTYPE m [<!ENTITY a "aaaa">]>')
    model = load(tmp_path, text).model
    assert "&a;" in [model.geom(index).name for index in range(model.ngeom)]


def test_sizes_and_options_of_a_file_do_not_reach_the_flight(tmp_path: Path) -> None:
    head = (
        '<size memory="900G" nconmax="2000000000" nuserdata="2000000000" nkey="2000000000" '
        'nuser_geom="2000000000"/><option wind="50 0 0" impratio="1e30" noslip_iterations="1000000"'
        ' iterations="1000000"/><visual><global offwidth="1000000" offheight="1000000"/>'
        '<quality numslices="100000" numstacks="100000"/></visual>'
    )
    model, plain = load(tmp_path, place("", head)).model, load(tmp_path, place()).model
    assert model.narena == plain.narena and model.nuserdata == model.nkey == 0
    for name in ("wind", "impratio", "noslip_iterations", "iterations"):
        np.testing.assert_array_equal(getattr(model.opt, name), getattr(plain.opt, name))
    assert model.vis.global_.offwidth <= 4096 and model.vis.quality.numslices <= 64


def test_plug_ins_of_actuators_are_left_out_with_them(tmp_path: Path) -> None:
    text = """<mujoco><extension><plugin plugin="mujoco.pid"/></extension><worldbody>
    <geom name="lawn" type="plane" size="50 50 1"/><body name="b" pos="9 0 1"><joint name="j"/>
    <geom name="building" size="1"/></body></worldbody><actuator><plugin joint="j"
    plugin="mujoco.pid"/></actuator></mujoco>"""
    assert load(tmp_path, text).model.nu == load(tmp_path, place()).model.nu


def test_names_in_warnings_do_not_steer_the_terminal(tmp_path: Path) -> None:
    (tmp_path / "place.xml").write_text(place(f'<geom name="a{chr(0x9B)}31m" size="1"/>'))
    with pytest.warns(UserWarning, match=re.escape(r"a\x9b31m")):
        load_scene(str(tmp_path / "place.xml"), 0)


def test_a_whole_command_ends_in_one_line(tmp_path: Path) -> None:
    sparse(tmp_path / "place.xml", b"<mujoco>", 40 << 20)
    done = limited("land", "place.xml", "--out", "run", "--quiet", folder=tmp_path)
    assert done.returncode == 2 and not (tmp_path / "run").exists()
    assert done.stderr.startswith("touchdown: error: ") and done.stderr.count("\n") == 1
    assert "32 MiB" in done.stderr
