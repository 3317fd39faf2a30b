"""Draws the moving picture of the front page, docs/images/landing.webp, from a recorded landing.

    touchdown land crossroad --seed 0
    python docs/make_landing_picture.py runs/crossroad-livo-0-land docs/images/landing.webp

Left: the vehicle at its true poses (truth.tum), the points of the final map (map.ply) that lie in
the LIDAR's field of view, and the flown path. Right: the camera's view, and the map where the LIDAR
has looked; after site selection the landing cost with the chosen site (costmap.png).
"""

from __future__ import annotations

import json
import sys
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import open3d as o3d
from PIL import Image, ImageDraw, ImageFont, ImageOps

from touchdown.experiments.io.tum import read_tum
from touchdown.scenes.compose import load_scene
from touchdown.sim.moving import MovingBodies

SIZE, VIEW, CAMERA, MAP = (800, 450), (500, 450), (298, 169), (298, 279)
FRAME_MS, LAST_MS, QUALITY = 100, 2000, 28
FRAMES_OF_PHASES = {"TAKEOFF": 16, "SURVEY": 42, "SELECT": 10, "APPROACH": 14, "DESCEND": 34}
CHOSEN = (80, 255, 80)
"""colour of the chosen site in costmap.png"""
CAPTIONS = {
    "TAKEOFF": "Climb",
    "SURVEY": "Survey and map",
    "SELECT": "Site selection",
    "APPROACH": "Approach",
    "DESCEND": "Descent, site recheck",
    "TOUCHDOWN": "Touchdown",
    "DONE": "Landed",
}
HALF_FOV = np.tan(0.5 * np.deg2rad([81.7, 25.1]))
"""Livox Horizon: sideways, ahead"""
MAP_CELL_M, BEAMS, UNKNOWN = 0.25, 90, (30, 32, 38)


class Flight:
    """Poses, phases and map points of a run directory."""

    def __init__(self, run: Path) -> None:
        self.result = json.loads((run / "result.json").read_text(encoding="utf-8"))
        self.times, self.positions, self.quats = read_tum(run / "truth.tum")
        cloud = o3d.io.read_point_cloud(str(run / "map.ply"))
        self.points, self.colours = np.asarray(cloud.points), np.asarray(cloud.colors)
        starts = {entry["phase"]: entry["time_s"] for entry in self.result["phases"]}
        ends = [*list(starts.values())[1:], self.times[-1]]
        spans = dict(zip(starts, zip(starts.values(), ends, strict=True), strict=True))
        self.starts = starts
        self.frame_times = np.concatenate(
            [np.linspace(*spans[p], n, endpoint=False) for p, n in FRAMES_OF_PHASES.items()]
            + [np.linspace(spans["TOUCHDOWN"][0], self.times[-1], 4)]
        )

    def pose(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        row = min(int(np.searchsorted(self.times, time_s)), len(self.times) - 1)
        return self.positions[row], self.quats[row]

    def phase(self, time_s: float) -> str:
        return [name for name, start in self.starts.items() if start <= time_s + 1e-6][-1]

    def in_view(self, position: np.ndarray, quat: np.ndarray) -> np.ndarray:
        """(N,) mask of the map points within the LIDAR's field of view; it looks along body -z."""
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, quat)
        body = (self.points - position) @ rotation.reshape(3, 3)
        depth = np.maximum(-body[:, 2], 0.3)
        return (np.abs(body[:, 1]) < HALF_FOV[0] * depth) & (
            np.abs(body[:, 0]) < HALF_FOV[1] * depth
        )


class Painter:
    """Renders the frames of one flight."""

    def __init__(self, run: Path) -> None:
        self.flight = flight = Flight(run)
        scene = load_scene(flight.result["scene"], flight.result["seed"])
        self.model, self.data = scene.model, mujoco.MjData(scene.model)
        self.traffic = MovingBodies(scene)
        self.model.vis.global_.fovy = 50.0
        self.model.vis.map.znear = 0.05 / self.model.stat.extent
        self.chase = mujoco.Renderer(self.model, 3 * VIEW[1] // 2, 3 * VIEW[0] // 2, max_geom=40000)
        self.down = mujoco.Renderer(self.model, 2 * CAMERA[1], 2 * CAMERA[0], max_geom=40000)
        self.options = mujoco.MjvOption()
        self.options.geomgroup[4] = 1  # the vehicle, which sensors do not draw
        self.seen = np.zeros(len(flight.points), bool)
        self.random = np.random.default_rng(0)
        self.cost = _cost_panel(run / "costmap.png")
        self.font, self.small = ImageFont.load_default(21), ImageFont.load_default(14)

    def frame(self, time_s: float, previous_s: float) -> Image.Image:
        flight = self.flight
        for at in np.arange(previous_s, time_s, 0.2):
            self.seen |= flight.in_view(*flight.pose(at))
        position, quat = flight.pose(time_s)
        self.data.qpos[:3], self.data.qpos[3:7] = position, quat
        self.traffic.write(self.data, time_s)
        mujoco.mj_forward(self.model, self.data)
        picture = Image.new("RGB", SIZE, (16, 17, 20))
        picture.paste(self._outside(time_s), (0, 0))
        self.down.update_scene(self.data, "vehicle/camera")
        picture.paste(Image.fromarray(self.down.render()).resize(CAMERA), (VIEW[0] + 2, 0))
        selected = time_s >= flight.starts["APPROACH"] - 0.5
        lower = self.cost if selected else self._map(position)
        picture.paste(lower, (VIEW[0] + 2, CAMERA[1] + 2))
        self._write(picture, time_s, "landing cost, chosen site" if selected else "map")
        return picture

    def _outside(self, time_s: float) -> Image.Image:
        """The vehicle from behind; low over the ground from nearer and flatter."""
        flight, eye = self.flight, mujoco.MjvCamera()
        position, quat = flight.pose(time_s)
        height = position[2] - flight.positions[-1][2]
        eye.lookat[:] = position - [0.0, 0.0, 0.1 + 0.012 * height]
        eye.distance = 2.0 + 0.028 * height
        eye.elevation = -17.0 - 0.75 * height
        eye.azimuth = 62.0 + 1.1 * (time_s - flight.starts["TAKEOFF"])
        self.chase.update_scene(self.data, eye, self.options)
        visible = np.flatnonzero(flight.in_view(position, quat))
        for point in self.random.choice(visible, min(BEAMS, len(visible)), replace=False):
            self._line(position - [0, 0, 0.12], flight.points[point], (0.3, 1.0, 0.5, 0.22), 1.0)
        path = flight.positions[: np.searchsorted(flight.times, time_s) : 25]
        for first, second in pairwise(path):
            self._line(first, second, (1.0, 0.62, 0.1, 0.9), 3.0)
        if time_s >= flight.starts["APPROACH"] - 0.5:
            self._mark(np.array([*flight.result["landing"]["site_xy_m"], flight.positions[-1][2]]))
        return Image.fromarray(self.chase.render()).resize(VIEW, Image.Resampling.LANCZOS)

    def _line(self, start: np.ndarray, end: np.ndarray, rgba: tuple[float, ...], px: float) -> None:
        scene = self.chase.scene
        geom = scene.geoms[scene.ngeom]
        kind = mujoco.mjtGeom.mjGEOM_LINE
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.float32(rgba))
        mujoco.mjv_connector(geom, kind, px, start, end)
        geom.emission = 1.0
        scene.ngeom += 1

    def _mark(self, site: np.ndarray) -> None:
        """A circle of 1 m around the chosen site."""
        angles = np.linspace(0.0, 2.0 * np.pi, 49)
        ring = site + np.column_stack([np.cos(angles), np.sin(angles), np.full(49, -0.17)])
        for first, second in pairwise(ring):
            self._line(first, second, (0.2, 1.0, 0.3, 1.0), 5.0)

    def _map(self, position: np.ndarray) -> Image.Image:
        """The coloured map from above, north up; the vehicle is the orange dot."""
        points = self.flight.points
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        cols, rows = np.ceil((high - low) / MAP_CELL_M).astype(int) + 1
        raster = np.full((rows, cols, 3), UNKNOWN, np.uint8)
        cell = ((points[self.seen, :2] - low) / MAP_CELL_M).astype(int)
        raster[cell[:, 1], cell[:, 0]] = 255.0 * self.flight.colours[self.seen]
        image = Image.fromarray(raster[::-1])
        dot = (position[:2] - low) / MAP_CELL_M
        x, y = dot[0], rows - dot[1]
        ImageDraw.Draw(image).ellipse((x - 7, y - 7, x + 7, y + 7), fill=(255, 160, 25))
        return ImageOps.pad(image, MAP, Image.Resampling.BOX, UNKNOWN)

    def _write(self, picture: Image.Image, time_s: float, lower: str) -> None:
        draw, phase = ImageDraw.Draw(picture), self.flight.phase(time_s)
        height = self.flight.pose(time_s)[0][2] - self.flight.positions[-1][2]
        rim = {"stroke_width": 2, "stroke_fill": (0, 0, 0)}
        caption = CAPTIONS[phase]
        if phase in ("TOUCHDOWN", "DONE"):
            offset_cm = 100.0 * self.flight.result["landing"]["target_offset_m"]
            caption = f"Landed, {offset_cm:.0f} cm from the chosen site"
        draw.text((14, 410), caption, "white", self.font, **rim)
        draw.text((14, 14), f"{max(height, 0.0):.1f} m above the site", "white", self.small, **rim)
        draw.text((VIEW[0] - 14, 14), f"{time_s:.0f} s", "white", self.small, anchor="ra", **rim)
        draw.text((VIEW[0] + 10, 6), "camera", "white", self.small, **rim)
        draw.text((VIEW[0] + 10, CAMERA[1] + 8), lower, "white", self.small, **rim)


def _cost_panel(path: Path) -> Image.Image:
    """The right map of costmap.png, without its margins."""
    picture = Image.open(path).convert("RGB")
    pixels = np.asarray(picture)
    inside = (pixels != pixels[0, 0]).any(axis=2)
    cols = np.flatnonzero(inside.mean(axis=0) > 0.5)  # the table below is narrower
    cols = cols[cols > cols[np.argmax(np.diff(cols))]]
    rows = np.flatnonzero(inside[:, cols].mean(axis=1) > 0.95)
    panel = picture.crop((int(cols[0]), int(rows[0]), int(cols[-1]) + 1, int(rows[-1]) + 1))
    site = np.argwhere((np.asarray(panel) == CHOSEN).all(axis=2)).mean(axis=0)
    x, y, radius = site[1], site[0], 0.045 * panel.width
    box = (x - radius, y - radius, x + radius, y + radius)
    ImageDraw.Draw(panel).ellipse(box, outline=(255, 60, 160), width=panel.width // 80)
    return ImageOps.pad(panel, MAP, Image.Resampling.LANCZOS, UNKNOWN)


def main(run: Path, out: Path) -> None:
    painter = Painter(run)
    times = painter.flight.frame_times
    frames = [painter.frame(t, times[max(i - 1, 0)]) for i, t in enumerate(times)]
    painter.chase.close()
    painter.down.close()
    durations = [FRAME_MS] * (len(frames) - 1) + [LAST_MS]
    rest = {"save_all": True, "append_images": frames[1:], "loop": 0, "method": 4}
    frames[0].save(out, duration=durations, quality=QUALITY, **rest)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
