"""A grass airfield: a mown runway with its markings, a windsock, parked aircraft, a hangar."""

from itertools import pairwise

import numpy as np

from touchdown.scenes.api import Array, Surface
from touchdown.scenes.authoring import relief
from touchdown.scenes.authoring.builder import SceneBuilder, turned
from touchdown.scenes.authoring.ground import Canvas, Ground
from touchdown.scenes.authoring.meshes import MeshData, polygon, walls
from touchdown.scenes.authoring.plane import draw_heading, unit
from touchdown.scenes.authoring.plots import Plot, SurveyFrame
from touchdown.scenes.places.turf.layout import furnish_path, stroke
from touchdown.scenes.props.garden import add_table
from touchdown.scenes.props.houses import House, add_house
from touchdown.scenes.props.street import add_fence, add_lamp, add_post
from touchdown.scenes.props.woods import Wood

AIRCRAFT = Surface(land_class="other", reflectivity=0.55)
TYRE = Surface(land_class="other", reflectivity=0.08)
MARKER = Surface(land_class="other", reflectivity=0.70)
_LIVERIES = ([0.80, 0.10, 0.12, 1], [0.10, 0.25, 0.60, 1], [0.95, 0.72, 0.10, 1],
             [0.10, 0.45, 0.30, 1])  # fmt: skip
_SEGMENTS = {"0": "abcdef", "1": "bc", "2": "abged", "3": "abgcd", "4": "fgbc", "5": "afgcd",
             "6": "afgedc", "7": "abc", "8": "abcdefg", "9": "gfabcd"}  # fmt: skip
_STROKES = {"a": ((0, 2), (1, 2)), "b": ((1, 2), (1, 1)), "c": ((1, 1), (1, 0)),
            "d": ((0, 0), (1, 0)), "e": ((0, 1), (0, 0)), "f": ((0, 2), (0, 1)),
            "g": ((0, 1), (1, 1))}  # fmt: skip


class Airfield:
    """The take-off spot lies beside the runway, which runs along the survey."""

    def __init__(self, rng: np.random.Generator, frame: SurveyFrame) -> None:
        self.plot: Plot = frame.from_middle
        self.runway_v = float(rng.uniform(-9.0, -5.0))
        self.half_width = float(rng.uniform(9.0, 11.0))
        self.half_length = 50.0
        self.apron_u = float(rng.uniform(-26.0, 4.0))
        self.hangar_v = 37.0
        ends = self.plot.at(-95.0, -34.0), self.plot.at(95.0, -37.0)
        self.ditch = relief.Ditch(start_xy_m=ends[0], end_xy_m=ends[1],
                           depth_m=float(rng.uniform(0.6, 0.9)), half_width_m=2.1)  # fmt: skip
        self.puddle = np.array([rng.uniform(-20.0, 25.0), rng.uniform(8.0, 14.0)])
        self.phase = draw_heading(rng)
        self.hangar = House(centre_xy_m=self.plot.at(self.apron_u, self.hangar_v),
                            angle=self.plot.angle, size_m=(16.0, 11.0, 3.6),
                            ridge_m=1.6)  # fmt: skip
        self.clubhouse = House(centre_xy_m=self.plot.at(self.apron_u + 19.0, self.hangar_v + 0.5),
                               angle=self.plot.angle, size_m=(9.0, 6.0, 2.8),
                               ridge_m=1.9)  # fmt: skip
        u = np.arange(-90.0, 91.0)
        self.path = self.plot.points(np.column_stack([u, np.full(len(u), self.hangar_v + 10.0)]))
        heading = round(float(np.rad2deg(0.5 * np.pi - self.plot.angle)) / 10.0) % 36 or 36
        self.numbers = (f"{heading:02d}", f"{(heading + 18 - 1) % 36 + 1:02d}")

    def shape(self, heights: Array, xy: Array) -> Array:
        uv = self.plot.coordinates(xy)
        across = np.abs(uv[..., 1] - self.runway_v)
        strip = 0.35 * heights
        heights = strip + (heights - strip) * relief.smoothstep(self.half_width, 26.0, across)
        apron = self.plot.pad(self.apron_u + 6.0, self.hangar_v - 4.0, (21.0, 11.0), 6.0)
        return relief.dig_ditches(relief.level_pads(heights, xy, [apron]), xy, [self.ditch])

    def pools(self, xy: Array) -> Array:
        rel = self.plot.coordinates(xy) - self.puddle
        angle = np.arctan2(rel[..., 1], rel[..., 0])
        edge = 2.2 * (1.0 + 0.25 * np.sin(2.0 * angle + self.phase) + 0.1 * np.sin(5.0 * angle))
        return np.asarray(0.06 * (edge - np.hypot(0.8 * rel[..., 0], 1.4 * rel[..., 1])))

    def free(self, xy_m: Array) -> Array:
        uv = self.plot.coordinates(xy_m)
        strip = np.abs(uv[..., 1] - self.runway_v) - self.half_width - 9.0
        apron = np.maximum(np.abs(uv[..., 0] - self.apron_u - 6.0) - 24.0,
                           np.abs(uv[..., 1] - self.hangar_v) - 13.0)  # fmt: skip
        between = np.maximum(uv[..., 1] - 40.0, -30.0 - uv[..., 1])
        ditch = relief.segment_distance(xy_m, self.ditch.start_xy_m, self.ditch.end_xy_m) - 1.0
        return np.minimum.reduce([strip, apron, np.maximum(between, 0.0), ditch])

    def paint(self, canvas: Canvas, rng: np.random.Generator) -> None:
        plot, v, w, half = self.plot, self.runway_v, self.half_width, self.half_length
        canvas.material[:] = int(Ground.MEADOW)
        canvas.fill(plot.rectangle((-90.0, 90.0), (v - w - 9.0, self.hangar_v - 6.0)), Ground.LAWN)
        canvas.fill(plot.rectangle((-half, half), (v - w, v + w)), Ground.FAIRWAY)
        apron = (self.apron_u - 11.0, self.apron_u + 25.0)
        canvas.fill(
            plot.rectangle(apron, (self.hangar_v - 15.5, self.hangar_v + 7.5)), Ground.GRAVEL
        )
        taxi = self.apron_u + rng.uniform(-5.0, 5.0)
        canvas.fill(plot.rectangle((taxi - 3.5, taxi + 3.5), (v + w, self.hangar_v - 15.0)),
                    Ground.FAIRWAY)  # fmt: skip
        canvas.track(self.path, 3.4, Ground.GRAVEL)
        canvas.track(np.array([self.ditch.start_xy_m, self.ditch.end_xy_m]), 0.9, Ground.MUD)
        along, sway = np.linspace(-0.8 * half, 0.7 * half, 40), 0.3 * np.sin(np.arange(40) / 5.0)
        for wheel in (-1.1, 1.1):
            canvas.trace(plot.points(np.column_stack([along, v + wheel + sway])), 0.3, 60)
        self._markings(canvas)

    def _markings(self, canvas: Canvas) -> None:
        plot, v, w, half = self.plot, self.runway_v, self.half_width, self.half_length
        for sign, number in ((-1.0, self.numbers[0]), (1.0, self.numbers[1])):
            for lane in np.linspace(-w + 1.6, w - 1.6, 8):
                if abs(lane) > 0.8:
                    ends = (sign * (half - 1.0), sign * (half - 8.0))
                    canvas.mark(plot.rectangle(ends, (v + lane - 0.45, v + lane + 0.45)), 225)
            self._number(canvas, number, sign)
        for u in np.arange(-half + 20.0, half - 18.0, 10.0):
            canvas.mark(plot.rectangle((u, u + 5.0), (v - 0.2, v + 0.2)), 225)
        for side in (-w, w):
            for u in np.arange(-half, half, 12.5):
                canvas.mark(plot.rectangle((u, u + 3.0), (v + side - 0.15, v + side + 0.15)), 225)

    def _number(self, canvas: Canvas, number: str, sign: float) -> None:
        """Two figures, upright for who lands from that end."""
        for place, figure in zip((-1.0, 1.0), number, strict=True):
            for name in _SEGMENTS[figure]:
                ends = np.array(_STROKES[name], np.float64)
                right = place * 1.9 + (ends[:, 0] - 0.5) * 2.2
                up = ends[:, 1] * 2.4
                uv = np.column_stack([sign * (self.half_length - 10.5 - up),
                                      self.runway_v + sign * right])  # fmt: skip
                stroke(canvas, self.plot.points(uv), 0.5, 225)

    def build(self, builder: SceneBuilder, wood: Wood) -> None:
        plot, rng = self.plot, builder.rng
        add_house(builder, self.hangar)
        add_house(builder, self.clubhouse)
        for house in (self.hangar, self.clubhouse):
            builder.claim(house.centre_xy_m, 9.0)
        door = plot.at(self.apron_u, self.hangar_v - 5.56)
        builder.geom("building_door", MARKER, box=[5.6, 0.06, 1.6], rgba=[0.42, 0.46, 0.50, 1],
                     pos=builder.on_ground(door, 1.6), heading=plot.angle)  # fmt: skip
        spots = rng.permutation(4)
        for index in range(int(rng.integers(2, 4))):
            u = self.apron_u - 8.0 + 12.5 * index
            heading = plot.angle - 0.5 * np.pi + rng.uniform(-0.25, 0.25)
            add_aircraft(builder, plot.at(u, self.hangar_v - 11.5), heading,
                         _LIVERIES[int(spots[index])])  # fmt: skip
        self._markers(builder)
        self._windsock(builder, plot.at(self.apron_u + 27.0, self.hangar_v - 15.0))
        for u in (17.0, 22.0):
            add_table(builder, plot.at(self.apron_u + u, self.hangar_v - 6.5), plot.angle)
        for u in (-12.0, 27.0):
            add_lamp(builder, plot.at(self.apron_u + u, self.hangar_v - 4.0),
                     plot.angle - 0.5 * np.pi, 6.0)  # fmt: skip
        for u in (-50.0, -25.0, 0.0, 25.0):
            ends = plot.at(u, self.hangar_v + 13.5), plot.at(u + 24.6, self.hangar_v + 13.5)
            if all((np.abs(end) < relief.HALF_M - 1.0).all() for end in ends):
                add_fence(builder, *ends, [0.50, 0.40, 0.30, 1])
        furnish_path(builder, self.path, plot.angle - 0.5 * np.pi, lamps=False)

    def _markers(self, builder: SceneBuilder) -> None:
        """White boards like low roofs along the edges of the runway."""
        v, w, half = self.runway_v, self.half_width, self.half_length
        profile = np.array([[-0.55, 0.0], [0.55, 0.0], [0.0, 0.26]])
        ends = [np.column_stack([np.full(3, x), profile]) for x in (-1.1, 1.1)]
        parts = [polygon(ends[1]), polygon(ends[0][::-1]), *walls(ends[0], ends[1])]
        mesh = builder.mesh("runway_marker", MeshData.join(parts))
        for side in (v - w - 0.9, v + w + 0.9):
            for u in np.arange(-half, half + 1.0, 12.5):
                spot = self.plot.at(u, side)
                at = builder.on_ground(spot)
                builder.geom("runway_marker", MARKER, mesh=mesh, pos=at,
                             heading=self.plot.angle, rgba=[0.95, 0.95, 0.93, 1])  # fmt: skip
                builder.cast(turned(np.concatenate(ends), self.plot.angle, at))
                builder.claim(spot, 1.0)

    def _windsock(self, builder: SceneBuilder, xy_m: Array) -> None:
        """A pole of 6 m with a striped sleeve in the wind."""
        add_post(builder, xy_m, 6.0, 0.06, [0.90, 0.90, 0.90, 1])
        wind = draw_heading(builder.rng)
        away = np.array([np.cos(wind), np.sin(wind), -0.25])
        start = builder.on_ground(xy_m, 5.85) + 0.2 * away
        for band in range(5):
            tint = [0.92, 0.35, 0.08, 1] if band % 2 == 0 else [0.95, 0.95, 0.93, 1]
            first, last = start + 0.42 * band * away, start + 0.42 * (band + 1) * away
            builder.geom("windsock", MARKER, rgba=tint,
                         cylinder=0.30 - 0.035 * band, fromto=[*first, *last])  # fmt: skip
            ball = 0.25 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], np.float64)
            builder.cast(np.concatenate([first + ball, last + ball]))
        builder.claim(xy_m, 1.0)


def add_aircraft(builder: SceneBuilder, xy_m: Array, heading: float, livery: list[float]) -> None:
    """Adds a parked high-winged light aircraft, 8 m long with 11 m of span."""
    origin = builder.on_ground(xy_m)
    white = [0.94, 0.94, 0.93, 1]
    stations = np.array([[3.1, 0.18, 1.15], [2.9, 0.42, 1.15], [1.9, 0.56, 1.25], [0.6, 0.60, 1.40],
                         [-0.9, 0.52, 1.35], [-4.6, 0.12, 1.45]])  # fmt: skip
    builder.geom("aircraft", AIRCRAFT, rgba=white, pos=origin,
                 mesh=builder.mesh(builder.unique("fuselage"), fuselage_mesh(stations)),
                 heading=heading)  # fmt: skip
    boxes: list[tuple[tuple[float, ...], tuple[float, ...], list[float], Surface]] = [
        ((0.3, 0.0, 2.02), (0.75, 5.5, 0.07), white, AIRCRAFT),
        ((0.3, 4.9, 2.03), (0.76, 0.6, 0.075), livery, AIRCRAFT),
        ((0.3, -4.9, 2.03), (0.76, 0.6, 0.075), livery, AIRCRAFT),
        ((-4.35, 0.0, 1.55), (0.45, 1.7, 0.04), livery, AIRCRAFT),
        ((-4.45, 0.0, 2.05), (0.42, 0.04, 0.60), livery, AIRCRAFT),
        ((0.75, 0.0, 1.72), (0.55, 0.58, 0.18), [0.10, 0.13, 0.16, 1], AIRCRAFT),
        ((3.18, 0.0, 1.15), (0.02, 0.95, 0.06), [0.12, 0.12, 0.12, 1], AIRCRAFT),
        ((2.3, 0.0, 0.25), (0.22, 0.07, 0.25), [0.08, 0.08, 0.08, 1], TYRE),
        ((-0.1, 1.1, 0.25), (0.22, 0.08, 0.25), [0.08, 0.08, 0.08, 1], TYRE),
        ((-0.1, -1.1, 0.25), (0.22, 0.08, 0.25), [0.08, 0.08, 0.08, 1], TYRE),
    ]
    for centre, half, tint, surface in boxes:
        at = turned(np.array([centre]), heading, origin)[0]
        builder.geom("aircraft_part", surface, box=list(half), rgba=tint, pos=at, heading=heading)
        builder.cast_box((half[0], half[1]), (-half[2], half[2]), heading, at)
    struts = ((0.5, 0.5, 0.95, 0.4, 2.6, 2.0), (0.0, 0.3, 1.0, -0.1, 1.1, 0.3))
    for sign in (1.0, -1.0):
        for strut in struts:
            ends = np.array(strut).reshape(2, 3) * [1.0, sign, 1.0]
            first, last = turned(ends, heading, origin)
            builder.geom("aircraft_strut", AIRCRAFT, capsule=0.035,
                         rgba=white, fromto=[*first, *last])  # fmt: skip
    wide = np.array([0.2, -0.2, 0.6, -0.6, 0.1, -0.1])
    low = np.column_stack([stations[[0, 0, 3, 3, 5, 5], 0], wide, np.full(6, 1.0)])
    builder.cast(turned(np.concatenate([low, low + [0.0, 0.0, 0.6]]), heading, origin))
    for along in (-4.0, 0.0, 2.5):
        builder.claim(xy_m + along * unit(heading), 4.5)


def fuselage_mesh(stations: Array) -> MeshData:
    """Returns an octagonal hull through ``stations``, (K, 3): position along x, radius, height of
    the axis."""
    turn = np.linspace(0.0, 2.0 * np.pi, 9)
    rings = [np.column_stack([np.full(9, x), r * np.cos(turn), z + 1.05 * r * np.sin(turn)])
             for x, r, z in stations]  # fmt: skip
    parts = []
    for front, back in pairwise(rings):
        for i in range(8):
            corners = np.array([front[i], front[i + 1], back[i + 1], back[i]])
            parts.append(polygon(corners[::-1]))
    return MeshData.join([*parts, polygon(rings[0][:-1]), polygon(rings[-1][:-1][::-1])])
