"""A hole of a golf course: fairway, green, bunkers, a pond, rough with trees."""

import numpy as np
from scipy.spatial import cKDTree

from touchdown.scenes.api import Array
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.meshes import box
from touchdown.scenes.authoring.plane import unit
from touchdown.scenes.authoring.plots import Plot, SurveyFrame
from touchdown.scenes.authoring.relief import HALF_M, cell_grid, smoothstep
from touchdown.scenes.places.turf.layout import furnish_path, plant_one
from touchdown.scenes.props.plants import add_rock
from touchdown.scenes.props.street import WOOD, add_bench, add_bin, add_post
from touchdown.scenes.props.woods import Wood

_COARSE = 1280


class Golf:
    """The take-off spot lies on the fairway; the green and its bunkers lie ahead."""

    def __init__(self, rng: np.random.Generator, frame: SurveyFrame) -> None:
        self.plot: Plot = frame.from_middle
        u = np.arange(-80.0, 27.0)
        v = -17.0 + 21.0 * smoothstep(rng.uniform(-36.0, -28.0), rng.uniform(22.0, 32.0), u)
        self.fairway = self.plot.points(np.column_stack([u, v]))
        self.fairway_m = float(rng.uniform(13.0, 15.5))
        self.green = np.array([rng.uniform(27.0, 31.0), rng.uniform(2.0, 6.0)])
        self.green_m = float(rng.uniform(9.5, 11.5))
        self.pin = self.green + rng.uniform(-4.0, 4.0, 2)
        self.phases = rng.uniform(0.0, 2.0 * np.pi, 8)
        turn = rng.uniform(0.0, 2.0 * np.pi) + np.array([0.0, 1.9, 3.9]) + rng.uniform(-0.3, 0.3, 3)
        reach = self.green_m + rng.uniform(4.5, 6.0, 3)
        ring = self.green + reach[:, None] * unit(turn)
        along = np.array([[rng.uniform(-14.0, -4.0), rng.uniform(9.0, 13.0)],
                          [rng.uniform(-4.0, 8.0), rng.uniform(-25.0, -21.0)]])  # fmt: skip
        self.bunkers = np.concatenate([ring, along])
        self.bunker_m = rng.uniform(2.6, 4.2, len(self.bunkers))
        self.pond = np.array([rng.uniform(-20.0, -8.0), rng.uniform(27.0, 31.0)])
        self.pond_m = float(rng.uniform(7.0, 9.5))
        w = np.arange(-90.0, 91.0)
        path_v = -34.0 + 4.0 * np.sin(w / 14.0 + self.phases[0])
        self.path = self.plot.points(np.column_stack([w, path_v]))
        self.tee = np.array([-57.0, -18.0])

    def _edge(self, uv: Array, centre: Array, radius: float, phase: float) -> Array:
        """Metres outside a wavy round shape, negative inside."""
        rel = uv - centre
        angle = np.arctan2(rel[..., 1], rel[..., 0])
        wave = 0.16 * np.sin(2.0 * angle + phase) + 0.10 * np.sin(3.0 * angle - 2.0 * phase)
        return np.hypot(rel[..., 0], rel[..., 1]) - radius * (1.0 + wave)

    def _bunker(self, uv: Array, index: int) -> Array:
        return self._edge(uv, self.bunkers[index], float(self.bunker_m[index]), self.phases[index])

    def shape(self, heights: Array, xy: Array) -> Array:
        uv = self.plot.coordinates(xy)
        heights = 1.7 * heights
        green = self._edge(uv, self.green, self.green_m, self.phases[6])
        inside = green < 0.0
        level = float(heights[inside].mean()) + 0.7 + 0.02 * (uv[..., 0] - self.green[0])
        heights = level + (heights - level) * smoothstep(0.5, 6.0, green)
        for index in range(len(self.bunkers)):
            edge = self._bunker(uv, index)
            lip = 0.35 * np.exp(-(((edge - 0.9) / 0.9) ** 2))
            heights = heights + lip - 0.95 * (1.0 - smoothstep(-2.2, 0.3, edge))
        shore = self._edge(uv, self.pond, self.pond_m, self.phases[7])
        water = float(heights[shore < 0.0].min()) - 0.35
        basin = water + 0.20 * np.maximum(shore, 0.0)
        return basin + (heights - basin) * smoothstep(0.6, 5.0, shore)

    def pools(self, xy: Array) -> Array:
        uv = self.plot.coordinates(xy)
        return -0.30 * self._edge(uv, self.pond, self.pond_m, self.phases[7])

    def free(self, xy_m: Array) -> Array:
        uv = self.plot.coordinates(xy_m)
        distance, _ = cKDTree(self.fairway).query(np.asarray(xy_m))
        gaps = [distance - self.fairway_m - 2.0, self._edge(uv, self.green, self.green_m,
                self.phases[6]) - 4.0, self._edge(uv, self.pond, self.pond_m, self.phases[7]) - 1.5,
                np.linalg.norm(uv - self.tee, axis=-1) - 8.0,
                cKDTree(self.path).query(np.asarray(xy_m))[0] - 2.0]  # fmt: skip
        gaps += [self._bunker(uv, index) - 2.0 for index in range(len(self.bunkers))]
        return np.asarray(np.min(np.broadcast_arrays(*gaps), axis=0))

    def paint(self, canvas: Canvas, rng: np.random.Generator) -> None:
        xy = cell_grid(_COARSE)
        uv = self.plot.coordinates(xy)
        distance, _ = cKDTree(self.fairway).query(xy)
        green = self._edge(uv, self.green, self.green_m, self.phases[6])
        material = np.full((_COARSE, _COARSE), int(Ground.ROUGH), np.uint8)
        sway = 1.6 * np.sin(uv[..., 0] / 6.0 + self.phases[1]) + np.sin(uv[..., 0] / 3.1)
        material[distance < self.fairway_m + 2.2 + sway] = int(Ground.LAWN)
        material[green < 4.0] = int(Ground.LAWN)
        material[distance < self.fairway_m + sway] = int(Ground.FAIRWAY)
        material[green < 1.4] = int(Ground.LAWN)
        material[green < 0.0] = int(Ground.GREEN)
        for index in range(len(self.bunkers)):
            material[self._bunker(uv, index) < 0.0] = int(Ground.SAND)
        material[self._edge(uv, self.pond, self.pond_m, self.phases[7]) < 0.5] = int(Ground.MUD)
        scale = len(canvas.material) // _COARSE
        canvas.material[:] = np.repeat(np.repeat(material, scale, axis=0), scale, axis=1)
        tee = self.tee
        canvas.fill(self.plot.rectangle((tee[0] - 4.0, tee[0] + 4.0), (tee[1] - 3.0, tee[1] + 3.0)),
                    Ground.GREEN)  # fmt: skip
        canvas.track(self.path, 2.2, Ground.GRAVEL)
        canvas.soil(self.plot.ring(float(self.pin[0]), float(self.pin[1]), 0.09, 12), 255)

    def build(self, builder: SceneBuilder, wood: Wood) -> None:
        rng, plot = builder.rng, self.plot
        pin = plot.at(*self.pin)
        add_post(builder, pin, 2.3, 0.02, [0.95, 0.93, 0.90, 1])
        z = builder.terrain.point(*pin)
        builder.geom("flag", WOOD, box=[0.28, 0.008, 0.18],
                     rgba=[0.85, 0.12, 0.12, 1], pos=[pin[0] + 0.28, pin[1], z + 2.1])  # fmt: skip
        add_bench(builder, plot.at(self.tee[0] - 1.0, self.tee[1] - 5.0), plot.angle)
        add_bin(builder, plot.at(self.tee[0] + 1.5, self.tee[1] - 5.0), [0.16, 0.30, 0.20, 1])
        self._cart(builder, self.path[int(rng.integers(60, 120))])
        self._rake(builder)
        for spot in plot.points(self.pond) + rng.normal(0.0, self.pond_m, (24, 2)):
            edge = float(self._edge(plot.coordinates(spot), self.pond, self.pond_m, self.phases[7]))
            if 0.2 < edge < 1.2 and builder.is_free(spot, 0.8):
                add_rock(builder, spot, float(rng.uniform(0.25, 0.6)))
        single = plot.points(rng.uniform([-40.0, -32.0], [45.0, 40.0], (60, 2)))
        single = single[(self.free(single) > 3.0) & (np.abs(single) < HALF_M - 4.0).all(axis=1)]
        for spot in single[:7]:
            if builder.is_free(spot, 3.5):
                plant_one(builder, wood, spot, bool(rng.random() < 0.35))
        furnish_path(builder, self.path, plot.angle + 0.5 * np.pi, lamps=False)

    def _cart(self, builder: SceneBuilder, xy_m: Array) -> None:
        """An electric cart on the path: body, roof, seats, wheels."""
        heading = self.plot.angle + 0.2
        white = [0.92, 0.92, 0.90, 1]
        parts = [
            box((1.15, 0.58, 0.16), (0.0, 0.0, 0.42)),
            box((0.25, 0.55, 0.16), (0.9, 0.0, 0.66)),
            box((0.30, 0.55, 0.12), (-0.25, 0.0, 0.70)),
            box((0.06, 0.55, 0.24), (-0.5, 0.0, 0.96)),
            box((0.95, 0.60, 0.03), (-0.05, 0.0, 1.86)),
        ]
        parts += [box((0.02, 0.02, 0.62), (sx, sy * 0.54, 1.25))
                  for sx in (-0.85, 0.75) for sy in (-1, 1)]  # fmt: skip
        builder.stand("cart", WOOD, parts, xy_m, heading, rgba=white)
        wheels = [box((0.22, 0.09, 0.22), (sx, sy * 0.55, 0.22))
                  for sx in (-0.75, 0.8) for sy in (-1, 1)]  # fmt: skip
        builder.stand("cart_wheels", WOOD, wheels, xy_m, heading, rgba=[0.1, 0.1, 0.1, 1])
        builder.claim(xy_m, 1.8)

    def _rake(self, builder: SceneBuilder) -> None:
        """A rake beside each bunker: too thin to see from 30 m."""
        for index, centre in enumerate(self.bunkers):
            away = centre - self.green
            away = away / max(float(np.hypot(*away)), 1e-6)
            reach = 1.4 * float(self.bunker_m[index]) + 0.5
            spot = self.plot.points(centre + reach * away)
            if (np.abs(spot) > HALF_M - 2.0).any():
                continue
            z = builder.terrain.point(*spot) + 0.08
            turn = float(builder.rng.uniform(0.0, np.pi))
            half = 0.85 * unit(turn)
            builder.geom("rake", WOOD, capsule=0.02, rgba=[0.80, 0.68, 0.45, 1],
                         fromto=[*(spot - half), z, *(spot + half), z])  # fmt: skip
            builder.geom("rake", WOOD, box=[0.03, 0.30, 0.05], rgba=[0.25, 0.25, 0.25, 1],
                         pos=[*(spot + half), z], heading=turn)  # fmt: skip
