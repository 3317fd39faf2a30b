"""A football ground: the pitch, its lines and goals, floodlights and a stand on a bank."""

from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring.builder import SceneBuilder
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.meshes import box
from touchdown.scenes.authoring.plane import left_of, pick, unit_circle
from touchdown.scenes.authoring.plots import Plot, SurveyFrame
from touchdown.scenes.authoring.relief import Ditch, dig_ditches, smoothstep
from touchdown.scenes.places.turf.layout import arc, furnish_path, stroke
from touchdown.scenes.props.playground import add_goal
from touchdown.scenes.props.street import STEEL, WOOD, add_post
from touchdown.scenes.props.woods import Wood

STAND = Surface(land_class="building", reflectivity=0.40)
SHELTER = Surface(land_class="building", reflectivity=0.30)
_WHITE = [0.93, 0.93, 0.92, 1.0]
CLUB_TINTS = ([0.72, 0.12, 0.12, 1], [0.10, 0.22, 0.55, 1], [0.10, 0.40, 0.20, 1])
CROWN = 0.005
"""The pitch falls from its middle to the touchlines by this fraction, so that rain runs off."""


class Pitch:
    """The take-off spot lies near a corner of the field of play."""

    def __init__(self, rng: np.random.Generator, frame: SurveyFrame) -> None:
        self.plot: Plot = frame.from_middle
        self.half = np.array([rng.uniform(41.0, 44.0), rng.uniform(26.5, 29.0)])
        self.bank = 1.0 if rng.random() < 0.5 else -1.0
        self.bank_m = float(rng.uniform(1.3, 2.0))
        edge = self.half[1] + 6.5
        far = 90.0
        self.ditch = Ditch(start_xy_m=self.plot.at(-far, -self.bank * (edge + 3.2)),
                           end_xy_m=self.plot.at(far, -self.bank * (edge + 2.2)),
                           depth_m=float(rng.uniform(0.5, 0.8)), half_width_m=1.9)  # fmt: skip
        end = 1.0 if rng.random() < 0.5 else -1.0
        self.puddles = [
            (np.array([end * (self.half[0] - rng.uniform(3.0, 9.0)), rng.uniform(-6.0, 6.0)]), 1.9),
            (rng.uniform(-0.6, 0.6, 2) * self.half, 1.1),
        ]
        self.phases = rng.uniform(0.0, 2.0 * np.pi, 2)
        u = np.arange(-90.0, 91.0)
        self.path = self.plot.points(np.column_stack([u, np.full(len(u), -self.bank * edge)]))
        self.tint = pick(rng, CLUB_TINTS)

    def _beyond(self, uv: Array) -> Array:
        """Metres outside the field of play, 0 on it."""
        out = np.maximum(np.abs(uv) - self.half, 0.0)
        return np.hypot(out[..., 0], out[..., 1])

    def shape(self, heights: Array, xy: Array) -> Array:
        uv = self.plot.coordinates(xy)
        play = -CROWN * np.abs(uv[..., 1]) + 0.15 * heights
        heights = play + (heights - play) * smoothstep(4.0, 14.0, self._beyond(uv))
        rise = smoothstep(self.half[1] + 4.0, self.half[1] + 9.5, self.bank * uv[..., 1])
        heights = heights + self.bank_m * rise * (1.0 - smoothstep(34.0, 46.0, np.abs(uv[..., 0])))
        return dig_ditches(heights, xy, [self.ditch])

    def pools(self, xy: Array) -> Array:
        uv = self.plot.coordinates(xy)
        depth = np.full(xy.shape[:-1], -1.0)
        for (centre, radius), phase in zip(self.puddles, self.phases, strict=True):
            rel = uv - centre
            angle = np.arctan2(rel[..., 1], rel[..., 0])
            edge = radius * (1.0 + 0.22 * np.sin(2.0 * angle + phase) + 0.1 * np.sin(5.0 * angle))
            depth = np.maximum(depth, 0.06 * (edge - np.hypot(rel[..., 0], 1.3 * rel[..., 1])))
        return depth

    def free(self, xy_m: Array) -> Array:
        uv = self.plot.coordinates(xy_m)
        path = np.abs(uv[..., 1] + self.bank * (self.half[1] + 8.5)) - 3.5
        return np.minimum(self._beyond(uv) - 4.0, path)

    def paint(self, canvas: Canvas, rng: np.random.Generator) -> None:
        plot, (a, b) = self.plot, self.half
        canvas.material[:] = int(Ground.LAWN)
        side = self.bank * np.array([b + 3.4, 90.0])
        canvas.fill(plot.rectangle((-90.0, 90.0), (side[0], side[1])), Ground.MEADOW)
        canvas.fill(plot.rectangle((-90.0, 90.0), (-self.bank * (b + 7.9), -self.bank * 90.0)),
                    Ground.ROUGH)  # fmt: skip
        canvas.fill(plot.rectangle((-a - 3.0, a + 3.0), (-b - 3.0, b + 3.0)), Ground.FAIRWAY)
        canvas.track(self.path, 2.4, Ground.GRAVEL)
        canvas.track(np.array([self.ditch.start_xy_m, self.ditch.end_xy_m]), 0.8, Ground.MUD)
        for sign in (1.0, -1.0):
            for mouth, radius in (((a - 1.2), 2.6), ((a - 10.5), 0.8)):
                fray = rng.uniform(0.75, 1.25, 26)[:, None]
                blot = np.array([sign * mouth, 0.0]) + fray * unit_circle(26) * [1.0, 1.5] * radius
                canvas.fill(plot.points(blot), Ground.WORN)
        self._lines(canvas)

    def _lines(self, canvas: Canvas) -> None:
        plot, (a, b) = self.plot, self.half

        def frame(u: tuple[float, float], v: float) -> Array:
            return plot.points(np.array([[u[0], -v], [u[1], -v], [u[1], v], [u[0], v], [u[0], -v]]))

        stroke(canvas, frame((-a, a), b))
        stroke(canvas, np.array([plot.at(0.0, -b), plot.at(0.0, b)]))
        stroke(canvas, arc(plot, 0.0, 0.0, 9.15, (0.0, 2.0 * np.pi)))
        canvas.mark(plot.ring(0.0, 0.0, 0.16, 12))
        for sign in (1.0, -1.0):
            stroke(canvas, frame((sign * a, sign * (a - 16.5)), 20.16))
            stroke(canvas, frame((sign * a, sign * (a - 5.5)), 9.16))
            canvas.mark(plot.ring(sign * (a - 11.0), 0.0, 0.16, 12))
            middle = np.pi if sign > 0.0 else 0.0
            reach = float(np.arccos(5.5 / 9.15))
            bow = arc(plot, sign * (a - 11.0), 0.0, 9.15, (middle - reach, middle + reach))
            stroke(canvas, bow)
            for side in (1.0, -1.0):
                first = np.arctan2(-side, -sign)
                span = (first - 0.25 * np.pi, first + 0.25 * np.pi)
                stroke(canvas, arc(plot, sign * a, side * b, 1.0, span))

    def build(self, builder: SceneBuilder, wood: Wood) -> None:
        plot, (a, b) = self.plot, self.half
        for sign in (1.0, -1.0):
            add_goal(builder, plot.at(sign * a, 0.0), plot.angle + (np.pi if sign > 0 else 0.0),
                     7.32, 2.44)  # fmt: skip
            for side in (1.0, -1.0):
                self._corner_flag(builder, plot.at(sign * a, side * b))
                self._floodlight(builder, plot.at(0.72 * sign * a, side * (b + 4.6)))
        inward = plot.angle - self.bank * 0.5 * np.pi
        self._stand(builder, plot.at(0.0, self.bank * (b + 10.2)), inward)
        for u in (-11.0, 11.0):
            self._dugout(builder, plot.at(u, -self.bank * (b + 3.4)), inward + np.pi)
        self._railing(builder)
        for sign in (1.0, -1.0):
            self._boards(builder, sign)
        furnish_path(builder, self.path, inward + np.pi, lamps=True)

    def _corner_flag(self, builder: SceneBuilder, xy_m: Array) -> None:
        add_post(builder, xy_m, 1.5, 0.02, [0.95, 0.85, 0.2, 1])
        z = builder.terrain.point(*xy_m)
        builder.geom("flag", WOOD, box=[0.2, 0.01, 0.13], rgba=self.tint,
                     pos=[xy_m[0] + 0.2, xy_m[1], z + 1.36])  # fmt: skip

    def _floodlight(self, builder: SceneBuilder, xy_m: Array) -> None:
        """A mast of 13 m with a row of lamps that look at the middle."""
        add_post(builder, xy_m, 13.0, 0.14, [0.62, 0.64, 0.66, 1])
        heading = float(np.arctan2(*(self.plot.origin_xy_m - xy_m)[::-1]))
        for level in (12.2, 12.9):
            at = builder.on_ground(xy_m, level)
            builder.geom("floodlight", STEEL, box=[0.10, 1.15, 0.24],
                         rgba=[0.86, 0.87, 0.86, 1], pos=at, heading=heading)  # fmt: skip
            builder.cast_box((0.1, 1.15), (-0.24, 0.24), heading, at)
        builder.claim(xy_m, 1.2)

    def _stand(self, builder: SceneBuilder, xy_m: Array, heading: float) -> None:
        """Five rows of benches on steps."""
        parts = [box((0.42, 12.0, 0.2 + 0.2 * k), (-0.85 * k, 0.0, 0.2 * k)) for k in range(5)]
        builder.stand("building_stand", STAND, parts, xy_m, heading, rgba=[0.66, 0.66, 0.64, 1])
        seats = [box((0.16, 11.7, 0.03),
                 (-0.85 * row - 0.05, 0.0, 0.62 + 0.4 * row)) for row in range(5)]  # fmt: skip
        builder.stand("building_seats", STAND, seats, xy_m, heading, rgba=self.tint)
        for v in np.arange(-12.0, 12.1, 3.0):
            builder.claim(xy_m + v * left_of(heading), 3.5)

    def _dugout(self, builder: SceneBuilder, xy_m: Array, heading: float) -> None:
        """The substitutes' shelter, open to the field behind it."""
        parts = [
            box((0.04, 2.6, 1.0), (0.75, 0.0, 1.0)),
            box((0.85, 2.6, 0.04), (-0.05, 0.0, 2.02)),
            box((0.6, 0.04, 1.0), (0.15, 2.56, 1.0)),
            box((0.6, 0.04, 1.0), (0.15, -2.56, 1.0)),
            box((0.2, 2.3, 0.04), (0.4, 0.0, 0.45)),
        ]
        builder.stand("building_dugout", SHELTER, parts, xy_m, heading, rgba=self.tint)
        for v in (-1.5, 1.5):
            builder.claim(xy_m + v * left_of(heading), 1.8)

    def _railing(self, builder: SceneBuilder) -> None:
        """A rail at hip height before the bank."""
        v = self.bank * (self.half[1] + 3.4)
        ends = [np.array([*self.plot.at(u, v), 0.0]) for u in np.linspace(-40.0, 40.0, 9)]
        for end in ends:
            end[2] = builder.terrain.point(end[0], end[1]) + 1.05
            add_post(builder, end[:2], 1.05, 0.03, _WHITE)
        for first, second in pairwise(ends):
            builder.geom("rail", STEEL, capsule=0.03, rgba=_WHITE, fromto=[*first, *second])
            flat = np.array([[0.03, 0.03, 0.0], [-0.03, -0.03, 0.0], [0.03, -0.03, 0.05]])
            builder.cast(np.concatenate([first + flat, second + flat]))

    def _boards(self, builder: SceneBuilder, sign: float) -> None:
        """Advertising boards behind a goal."""
        tints = ([0.90, 0.88, 0.84, 1], self.tint, [0.92, 0.78, 0.22, 1], [0.2, 0.3, 0.5, 1])
        for v in np.linspace(-15.0, 15.0, 6):
            spot = self.plot.at(sign * (self.half[0] + 3.6), v)
            tint = pick(builder.rng, tints)
            at = builder.on_ground(spot, 0.45)
            builder.geom("board", WOOD, box=[0.04, 2.4, 0.45], rgba=tint,
                         pos=at, heading=self.plot.angle)  # fmt: skip
            builder.cast_box((0.04, 2.4), (-0.45, 0.45), self.plot.angle, at)
            builder.claim(spot, 2.0)
