"""Untrusted MJCF files: limits on counts, sizes and files, each refused in one line."""

import re
import struct
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from touchdown.scenes.api import Scene
from touchdown.scenes.compose import load_scene
from touchdown.scenes.importers import mjcf_limits, model_check, trial
from touchdown.scenes.importers.mjcf_limits import check_mjcf
from touchdown.sim.files import child

from support.hostile_files import limited, pipe, png, sparse

FLOOR = '<geom name="lawn" type="plane" size="100 100 1"/>'
TEXTURE = '<asset><texture name="t" type="2d" {}/><material name="m" texture="t"/></asset>'
FIELD = '<asset><hfield name="h" size="9 9 1 1" {}/></asset>'
MESH = '<asset><mesh name="h" {}/></asset>'
ON_FIELD, ON_MESH = '<geom type="hfield" hfield="h"/>', '<geom type="mesh" mesh="h"/>'
BOWL = '<extension><plugin plugin="mujoco.sdf.bowl"><instance name="b"/></plugin></extension>'
ENTITIES = '<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
DEEP = 600


@pytest.fixture(autouse=True)
def _nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """The error is one line, whatever MuJoCo's readers say besides."""
    yield
    assert not capfd.readouterr().err


def place(body: str = "", head: str = "", before: str = "") -> str:
    return f"{before}<mujoco>{head}<worldbody>{FLOOR}{body}</worldbody></mujoco>"


def load(folder: Path, text: str) -> Scene:
    (folder / "place.xml").write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_scene(str(folder / "place.xml"), 0)


def refused(folder: Path, text: str, message: str) -> None:
    """One sentence, at once: nothing was expanded, opened or compiled."""
    (folder / "place.xml").write_text(text)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with pytest.raises(ValueError, match=message) as caught:
            load_scene(str(folder / "place.xml"), 0)
    assert "\n" not in str(caught.value) and not said


@pytest.mark.parametrize(("text", "message"), [
    (place(ON_FIELD, FIELD.format('nrow="100000" ncol="100000"')),
     "'h' has 100000 x 100000 cells, more than 4194304"),
    (place("", TEXTURE.format('builtin="flat" width="30000" height="30000"')),
     "'t' has 30000 x 30000 pixels, more than 16384 along a side"),
    (place("", TEXTURE.format('builtin="flat" width="16000" height="16000"')),
     "more than 134217728 with all others"),
    (place('<replicate count="1000000000" offset="1 0 0"><geom size=".1"/></replicate>'),
     "1000000001 geoms, more than 10000"),
    (place('<replicate count="110" offset="1 0 0"><replicate count="100" offset="0 1 0">'
           '<geom size=".1"/></replicate></replicate>'), "11001 geoms, more than 10000"),
    (place(''.join(f'<geom size=".2" pos="{i % 140} {i // 140} 1"/>' for i in range(19_600))),
     "it has 19601 geoms, more than 10000; join small ones to meshes"),
    (place('<flexcomp type="grid" count="2000 2000 200" spacing="1 1 1" name="f" dim="3"/>'),
     "bodies, more than 10000"),
    (place('<body><joint/><geom size="1"/></body>' * 3000), "3000 joints, sensors and actuat"),
    (place("<body>" * DEEP + '<geom size="1"/>' + "</body>" * DEEP), "nested more than 400"),
    (place(ON_MESH, MESH.format('builtin="supersphere" params="20000 .5 .5"')),
     "resolution of 20000, more than 1000"),
    (place("", before=ENTITIES), "has a DOCTYPE, which MJCF has not; remove it"),
    (place("", before='<!DOCTYPE m [<!-- > <mujoco>EVIL</mujoco> -->]>'), "has a DOCTYPE"),
    (place('<geom type="sdf" mesh="b"><plugin instance="b"/></geom>', BOWL),
     "signed distance field|plug-in"),
    (place('<geom type="mesh" mesh="b"/>',
           f'{BOWL}<asset><mesh name="b"><plugin instance="b"/></mesh></asset>'),
     "plug-in 'b'"),
    (place('<geom name="[/x]" size="1" pos="1e300 0 0"/>'), r"geom '\[/x\]' lies"),
    (place('<geom type="hfield" hfield="line"/>',
           '<asset><hfield name="line" nrow="1" ncol="9" size="1 1 1 1"/></asset>'),
     "height field 'line' has fewer than 2 rows"),
    ('<robot name="r"><link name="a"/></robot>', "the root of .* is <robot>"),
    ("<mujoco><worldbody></mujoco>", "is not XML: mismatched tag"),
    ("<mujoco><worldbody/></mujoco></mujoco>", "correct it there, or, if MuJoCo opens it, save"),
    (place('<geom size="1" pos="nan 0 0"/>'), "geom .* NaN or infinite"),
    (place('<body pos="inf 0 0"><geom size="1"/></body>'), "NaN or infinite"),
    (place('<geom name="far" size="1" pos="1e300 0 0"/>'), "geom 'far' lies or reaches"),
    (place('<geom size="inf"/>'), "NaN or infinite"),
    (place('<geom size="1e30"/>'), "farther than 1e\\+08 m"),
    (place('<geom size="1" friction="nan 0 0"/>'), "NaN or infinite .geom_friction"),
    (place(ON_FIELD, FIELD.format('nrow="2" ncol="2" elevation="0 0 nan 0"')),
     "height field 'h' has a number that is NaN"),
])  # fmt: skip
def test_what_a_file_declares_is_limited(tmp_path: Path, text: str, message: str) -> None:
    refused(tmp_path, text, message)


@pytest.mark.parametrize(("head", "body", "word"), [
    (MESH.format('file="{}.obj"'), ON_MESH, "mesh"),
    (TEXTURE.format('file="{}.png"'), "", "texture"),
    (FIELD.format('file="{}.bin"'), ON_FIELD, "height field"),
    ('<include file="{}.xml"/>', "", "include"),
    ('<asset><model name="q" file="{}.xml"/></asset>', "", "model"),
    ('<deformable><skin name="s" file="{}.skn"/></deformable>', "", "mesh"),
])  # fmt: skip
@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_is_no_file_is_not_opened(
    tmp_path: Path, head: str, body: str, word: str, kind: str
) -> None:
    for ending in ("obj", "png", "bin", "xml", "skn"):
        target = tmp_path / f"{kind}.{ending}"
        if kind == "pipe":
            pipe(target)
        elif kind == "folder":
            target.mkdir()
        else:
            target.symlink_to("/dev/zero")
    named = {"pipe": "named pipe", "folder": "directory", "device": "device"}[kind]
    refused(tmp_path, place(body, head.format(kind)), f"{word} .*is a {named}; give a file")


def test_a_scene_that_is_no_file(tmp_path: Path) -> None:
    for path, word in ((pipe(tmp_path / "p.xml"), "named pipe"), (tmp_path, "directory")):
        with pytest.raises(ValueError, match=f"a scene '.*' is a {word}; give a file"):
            load_scene(f"{path}/" if path == tmp_path else str(path), 0)


def test_headers_of_assets_are_read_before_the_assets(tmp_path: Path) -> None:
    (tmp_path / "bomb.png").write_bytes(png(30_000, 30_000))
    sparse(tmp_path / "wide.bin", struct.pack("<ii", 100_000, 100_000), 8)
    sparse(tmp_path / "heavy.obj", b"v 0 0 0\n", 300 << 20)
    sparse(tmp_path / "long.xml", b"<mujoco>", 40 << 20)
    refused(tmp_path, place("", TEXTURE.format('file="bomb.png"')), "30000 x 30000 pixels")
    refused(tmp_path, place(ON_FIELD, FIELD.format('file="bomb.png"')), "30000 x 30000 cells")
    refused(tmp_path, place(ON_FIELD, FIELD.format('file="wide.bin"')), "100000 x 100000 cells")
    refused(tmp_path, place(ON_MESH, MESH.format('file="heavy.obj"')),
            "it has 301 MiB of meshes, more than 256; simplify")  # fmt: skip
    refused(tmp_path, '<mujoco><include file="long.xml"/></mujoco>', "40 MiB, and .* 32 MiB")
    # wherever the compiler element sends MuJoCo
    (tmp_path / "deep").mkdir()
    (tmp_path / "bomb.png").rename(tmp_path / "deep" / "bomb.png")
    head = '<compiler texturedir="deep"/>' + TEXTURE.format('file="x/bomb.png"')
    refused(tmp_path, place("", head.replace("<compiler", '<compiler strippath="true"')), "30000")


@pytest.mark.parametrize(("files", "message"), [
    ({"place.xml": '<mujoco><include file="place.xml"/></mujoco>'}, "includes itself"),
    ({"place.xml": '<mujoco><include file="a.xml"/></mujoco>',
      "a.xml": '<mujoco><include file="place.xml"/></mujoco>'}, "includes itself"),
    ({"place.xml": place('<attach model="q" prefix="p"/>',
                         '<asset><model name="q" file="place.xml"/></asset>')},
     "contains itself"),
    ({"place.xml": place('<attach model="q" prefix="p"/>',
                         '<asset><model name="q" file="a.xml"/></asset>'),
      "a.xml": place('<body name="b"/>', '<asset><model name="q" file="place.xml"/></asset>')},
     "contains itself"),
    ({"place.xml": place('<replicate count="2000"><attach model="q" prefix="p"/></replicate>',
                         '<asset><model name="q" file="a.xml"/></asset>'),
      "a.xml": place('<geom size="1"/>' * 9)}, "geoms, more than 10000"),
])  # fmt: skip
def test_files_that_contain_one_another(
    tmp_path: Path, files: dict[str, str], message: str
) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    refused(tmp_path, files["place.xml"], message)


def test_a_model_without_a_name_counts_by_its_own(tmp_path: Path) -> None:
    for own, used in (("", "MuJoCo Model"), ('model="kid"', "kid")):
        text = place('<geom size="1"/>' * 2000).replace("<mujoco", f"<mujoco {own}")
        (tmp_path / "child.xml").write_text(text)
        attached = "".join(f'<attach model="{used}" prefix="p{i}"/>' for i in range(100))
        refused(tmp_path, place(attached, '<asset><model file="child.xml"/></asset>'),
                "it has 10006 geoms, more than 10000")  # fmt: skip


def test_an_asset_is_measured_wherever_mujoco_may_open_it(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "t.png").write_bytes(png(8, 8, inflated=200))
    (tmp_path / "deep" / "t.png").write_bytes(png(30_000, 30_000))
    head = '<compiler texturedir="deep"/>' + TEXTURE.format('file="t.png"')
    refused(tmp_path, place("", head), "30000 x 30000 pixels")


def test_no_more_is_inflated_than_an_image_needs(tmp_path: Path) -> None:
    (tmp_path / "bomb.png").write_bytes(png(8, 8, inflated=1 << 26))
    for head, kind in ((TEXTURE, "texture 't'"), (FIELD, "height field 'h'")):
        refused(tmp_path, place("", head.format('file="bomb.png"')),
                f"{kind}: 'bomb.png' inflates to more than its size in pixels needs")  # fmt: skip


def test_vertices_in_the_file_count_as_those_of_mesh_files(tmp_path: Path) -> None:
    vertices = " ".join(["0.25"] * 900)
    (tmp_path / "place.xml").write_text(place(ON_MESH, MESH.format(f'vertex="{vertices}"')))
    assert check_mjcf(tmp_path / "place.xml")["mesh bytes"] >= len(vertices)


@pytest.mark.parametrize(("text", "message"), [
    (place('<geom size=".1"/>' * 10_001), "it has 10002 geoms, more than 10000"),
    (place().replace("</mujoco>", f"<sensor>{'<clock/>' * 2001}</sensor></mujoco>"),
     "2001 joints, sensors and actuators"),
    (place("", FIELD.format('nrow="9000" ncol="9000"')), "81000000 cells of height fields"),
    (place("", TEXTURE.format('builtin="flat" width="16000" height="16000"')),
     "256000000 pixels of textures"),
    (place("", MESH.format('vertex="' + "0 " * 300_000 + '"')), "2 MiB of meshes, more than 1"),
])  # fmt: skip
def test_what_mujoco_itself_has_read_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    """Where its reader of XML sees another document than ours."""
    monkeypatch.setattr("touchdown.scenes.importers.mjcf.check_mjcf", lambda path: Counter())
    limits = [(*one[:1], 1, *one[2:]) if one[0] == "mesh MiB" else one
              for one in mjcf_limits._LIMITS]  # fmt: skip
    monkeypatch.setattr(mjcf_limits, "_LIMITS", limits)
    refused(tmp_path, text, message)


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


def test_ordinary_files_are_within_the_limits(tmp_path: Path) -> None:
    text = place('<replicate count="50" offset="1 0 0"><geom size=".1"/></replicate>',
                 TEXTURE.format('builtin="checker" width="512" height="512"'))  # fmt: skip
    (tmp_path / "place.xml").write_text(text)
    census = check_mjcf(tmp_path / "place.xml")
    assert (census["geom"], census["texels"]) == (51, 512 * 512)
    assert load(tmp_path, text).model.ngeom > 51


def test_text_in_another_encoding_is_named(tmp_path: Path) -> None:
    (tmp_path / "place.xml").write_bytes(place("<!-- größe -->").encode("latin-1"))
    with pytest.raises(ValueError, match="is not UTF-8 text"):
        load_scene(str(tmp_path / "place.xml"), 0)


def test_triangles_of_all_geoms_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_check, "MAX_TRIANGLES", 1000)
    text = place(ON_FIELD * 3, FIELD.format('nrow="20" ncol="20"'))
    refused(tmp_path, text, "its geoms have 2400 triangles, more than 1000")


def _cloud(path: Path, points: int) -> Path:
    """An OBJ of triangles on a sphere: every point is part of the convex hull."""
    found = np.random.default_rng(0).standard_normal((points, 3))
    found *= 10.0 / np.linalg.norm(found, axis=1)[:, None]
    lines = [f"v {x} {y} {z}" for x, y, z in found]
    lines += [f"f {i} {i + 1} {i + 2}" for i in range(1, points - 1, 3)]
    path.write_text("\n".join(lines))
    return path


def test_a_mesh_that_takes_too_long_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _cloud(tmp_path / "ball.obj", 300)
    monkeypatch.setattr(child, "_WAIT_S", 0.0)
    monkeypatch.setattr("touchdown.scenes.importers.mjcf.TRIAL_BYTES", 1000)
    refused(tmp_path, place(ON_MESH, MESH.format('file="ball.obj"')),
            "needs more than 0 s to compile it; simplify its meshes")  # fmt: skip


def test_a_trial_ends_with_the_verdict_of_mujoco(tmp_path: Path) -> None:
    _cloud(tmp_path / "ball.obj", 300)
    (tmp_path / "place.xml").write_text(place(ON_MESH, MESH.format('file="ball.obj"')))
    trial.check_compiles(tmp_path / "place.xml")
    (tmp_path / "place.xml").write_text(place(ON_MESH, MESH.format('file="gone.obj"')))
    trial.check_compiles(tmp_path / "place.xml")  # the compilation itself names what is missing


def test_names_in_warnings_do_not_steer_the_terminal(tmp_path: Path) -> None:
    text = place(f'<geom name="a{chr(0x9B)}31m" size="1"/>')
    (tmp_path / "place.xml").write_text(text)
    with pytest.warns(UserWarning, match=re.escape(r"a\x9b31m")):
        load_scene(str(tmp_path / "place.xml"), 0)


def test_a_whole_command_ends_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "place.xml").write_text(
        place(ON_FIELD, FIELD.format('nrow="100000" ncol="100000"'))
    )
    done = limited("land", "place.xml", "--out", "run", "--quiet", folder=tmp_path)
    assert done.returncode == 2 and not (tmp_path / "run").exists()
    assert done.stderr.startswith("touchdown: error: ") and done.stderr.count("\n") == 1
    assert str(mjcf_limits.MAX_CELLS) in done.stderr


def test_a_mesh_without_a_hull_is_refused_in_one_line(tmp_path: Path) -> None:
    corners = ("0 0 0", "4 0 0", "0 4 0", "0 0 2", "1e400 0 0")
    faces = ("1 2 4", "2 3 4", "5 1 4")
    lines = [*(f"v {corner}" for corner in corners), *(f"f {face}" for face in faces)]
    (tmp_path / "m.obj").write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match="is flat"):
        load(tmp_path, place(ON_MESH, MESH.format('file="m.obj"')))
