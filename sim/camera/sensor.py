"""An offscreen camera: MuJoCo's renderer with the lens, noise and threading of a sensor.

The physics thread takes a ``Snapshot`` (a few array copies); one thread, the physics' own or a
worker, turns snapshots into images with an MjData, a GL context and a scene of its own. The GIL
is free while pixels are drawn and read.
"""

import threading
from dataclasses import dataclass
from typing import Any, NamedTuple
from zlib import crc32

import cv2
import mujoco
import numpy as np

from touchdown.scenes.api import Scene
from touchdown.sim.api import CameraIntrinsics, CameraParams, FaultParams, LampParams
from touchdown.sim.camera import optics
from touchdown.sim.camera.degradations import CameraDegradations, ImageDefects
from touchdown.sim.camera.detail_texture import DetailTexture
from touchdown.sim.camera.gl import InverseDepth, Snapshot, Stage
from touchdown.sim.camera.image_sensor import NoisePlace
from touchdown.sim.camera.mover_shadows import MoverShadows
from touchdown.sim.camera.row_exposures import RowExposures, exposes_rows, takes_time
from touchdown.sim.camera.shutter import CameraMotion, camera_motion, margin_px
from touchdown.sim.camera.vegetation import Vegetation
from touchdown.sim.dust import DustCloud
from touchdown.sim.effects import Effects
from touchdown.sim.moving import BodyTrack
from touchdown.sim.typing import Bytes, Float32, Int32

CAMERA_NAME = "vehicle/camera"


@dataclass(frozen=True, slots=True)
class GroundEffects:
    """Appearance of the ground beside its geometry."""

    dust: DustCloud | None = None
    """raised by the rotors"""
    vegetation: Vegetation | None = None
    """of plants"""


_BARE = GroundEffects()


class _Drawn(NamedTuple):
    """A drawing, and its depths where they have been read."""

    image: Bytes
    depth: InverseDepth | None


class CameraSensor:
    """The camera ``camera_name`` of ``scene``, with the resolution, field of view and lens of
    ``params`` (the model's own are not looked at).

    ``render``, ``render_depth`` and ``render_segmentation`` show one instant through the same lens;
    they may run in any one thread: the GL context is made at the first image and belongs to the
    thread that asked for it. Grey noise depends on (seed, camera, tick) alone. ``faults`` of the
    clock ``tick_hz`` and ``dust`` degrade the images of ``render``. ``ground``: what it sees of
    dust and plants.

    Raises ValueError when the model has no such camera or the parameters are impossible; rendering
    raises RuntimeError when there is no way to render on this machine, or when called from a second
    thread.
    """

    def __init__(
        self,
        scene: Scene,
        params: CameraParams,
        seed: int,
        camera_name: str = CAMERA_NAME,
        faults: FaultParams | None = None,
        tick_hz: int = 600,
        lamp: LampParams | None = None,
        ground: GroundEffects = _BARE,
    ) -> None:
        self._model = scene.model
        self._params = params
        self._lens = optics.make_lens(params)
        self.effects = Effects()
        """of air, optics, exposure and lamp on images"""
        self._rows: RowExposures | None = None
        if exposes_rows(params, scene.light):
            exposure_s = params.exposure_max_s if takes_time(params, scene.light) else 0.0
            margin = margin_px(self._lens.raster, params.readout_s, exposure_s)
            self._lens = optics.with_margin(self._lens, margin)
            key = [seed, crc32(b"electrons of " + camera_name.encode())]
            self._rows = RowExposures(self._lens, params, lamp or LampParams(), scene.light, key)
            self._rows.effects = self.effects
        self._camera_id = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, camera_name)
        if self._camera_id < 0:
            names = [self._model.camera(i).name for i in range(self._model.ncam)]
            raise ValueError(
                f"scene '{scene.name}' has no camera '{camera_name}': its cameras are "
                f"{', '.join(names) or 'none'}"
            )
        self._noise_key = [seed, crc32(camera_name.encode())]
        self._noise = optics.noise_tile(params, self._noise_key)
        self._degradations = CameraDegradations(
            faults or FaultParams(), tick_hz, params, self._lens.raster, self._model, seed,
            camera_name, dust=ground.dust,
        )  # fmt: skip
        self._degradations.effects = self.effects
        self._vegetation = ground.vegetation
        self._detail = (
            DetailTexture(scene, self._lens.raster, ground.vegetation) if params.detail else None
        )
        self._shadows = MoverShadows.of(scene, self._lens.raster)
        self.renderer: str | None = None
        """what drew the images so far (`gl_contexts.renderer_name`); None without one"""
        self._stage: Stage | None = None
        self._thread: int | None = None

    def intrinsics(self) -> CameraIntrinsics:
        """Focal lengths that follow from the two fields of view, and the lens distortion."""
        return self._lens.image

    def snapshot(self, data: mujoco.MjData) -> Snapshot:
        """Copies the state that an image depends on. Call it in the physics thread, after the
        kinematics."""
        return Snapshot.of(data)

    def render(self, snapshot: Snapshot, tick: int) -> Bytes:
        """(H, W, 3) uint8 RGB image, read-only, with the grey noise of ``tick``."""
        if self._rows is not None:
            return self._develop(snapshot, tick, None, 0.0, 0.0)
        defects = self._degradations.at(tick)
        plain = self._lens.map_x is None and defects is None
        if plain:  # the common case: `develop` flips, so that nothing is copied twice
            raw = self._drawn(self._own_stage(), snapshot, 0, self._params.height).image
        else:
            raw = self._through_air_and_lens(snapshot, defects)
        if defects is not None:
            raw = self._degradations.through_lens(defects, raw, snapshot)
        table = optics.exposure_table(self._params, raw)
        if table is not None:
            raw = cv2.LUT(raw, table).astype(np.uint8, copy=False)
        image = np.empty_like(raw)
        row, col, sign = self._noise_place(tick)
        optics.develop(raw, self._noise, row, col, sign, plain, image)
        image.setflags(write=False)
        return image

    @property
    def exposes_rows(self) -> bool:
        """True where images depend on the motion during readout and exposure: `render_rows`."""
        return self._rows is not None

    @property
    def takes_time(self) -> bool:
        """True where exposures take a time."""
        return self._rows is not None and self._rows.takes_time

    def render_rows(
        self, snapshot: Snapshot, at_s: float, track: BodyTrack, end_s: float, tick: int
    ) -> Bytes:
        """(H, W, 3) uint8 RGB image, read-only, each row from the poses of its exposure, the last
        one about ``end_s``. ``snapshot``: the instant ``at_s`` in the middle of the readout;
        ``track``: of the body that carries the camera, from the first exposure to the last.
        RuntimeError for a camera without `exposes_rows`."""
        if self._rows is None:
            raise RuntimeError("all rows of this camera are exposed at once: call render()")
        motion = camera_motion(track, snapshot, self._camera_id, at_s)
        return self._develop(snapshot, tick, motion, end_s - at_s, end_s)

    def _develop(
        self,
        snapshot: Snapshot,
        tick: int,
        motion: CameraMotion | None,
        end_s: float,
        time_s: float,
    ) -> Bytes:
        assert self._rows is not None
        stage, raster = self._own_stage(), self._lens.raster
        drawn, read = self._drawn(stage, snapshot, 0, raster.height)
        depth = read or stage.inverse_depth_of_last(raster.height)
        defects = self._degradations.at(tick)
        if defects is not None and defects.extinction > 0.0:
            drawn = self._degradations.through_air(defects, drawn, depth.metres(), 0)
        place = self._noise_place(tick)
        image, white = self._rows.develop(drawn, depth, motion, end_s, time_s, self._noise, place)
        if defects is not None:
            image = self._degradations.through_lens(defects, image, snapshot, white)
        if not self._rows.takes_time:
            table = optics.exposure_table(self._params, image)
            image = image if table is None else cv2.LUT(image, table).astype(np.uint8, copy=False)
        return _frozen(image)

    def render_depth(self, snapshot: Snapshot) -> Float32:
        """(H, W) float32, read-only: true depth along the optical axis in metres, without noise;
        ``inf`` where there is nothing."""
        return _frozen(self._bent(self._own_stage().depth(snapshot, self._camera_id)))

    def render_segmentation(self, snapshot: Snapshot) -> Int32:
        """(H, W) int32, read-only: id of the geom that each pixel shows, -1 for none."""
        ids = self._own_stage().geom_ids(snapshot, self._camera_id)
        # remap knows no int32; 24 bits of an id fit a float32.
        return _frozen(self._bent(ids.astype(np.float32)).astype(np.int32))

    def close(self) -> None:
        """Frees the GL context; call it in the thread that rendered."""
        if self._stage is not None:
            self._stage.close()
        self._stage, self._thread = None, None

    def _drawn(self, stage: Stage, instant: Snapshot, first: int, last: int) -> _Drawn:
        """`Stage.colour` of rows ``first`` to ``last``, with the ground's detail texture and the
        shadows of who walks there."""
        drawn, depth = stage.colour(instant, self._camera_id, first, last), None
        if self._detail is not None and self._detail.needed(instant, self._camera_id):
            depth = stage.inverse_depth_of_last(last - first)
            self._detail.add(drawn, depth, instant, self._camera_id, last)
        if self._shadows is not None:
            depth = depth or stage.inverse_depth_of_last(last - first)
            self._shadows.darken(drawn, depth, instant, self._camera_id, last)
        return _Drawn(drawn, depth)

    def _through_air_and_lens(self, instant: Snapshot, defects: ImageDefects | None) -> Bytes:
        """(H, W, 3) image, top row first."""
        rows = slice(0, self._params.height)
        first, last = optics.raster_rows(self._lens, rows)
        stage = self._own_stage()
        drawn = self._drawn(stage, instant, first, last).image
        if defects is not None and defects.extinction > 0.0:
            depth = stage.inverse_depth_of_last(last - first).metres()
            drawn = self._degradations.through_air(defects, drawn, depth, first)
        upright = np.ascontiguousarray(drawn[::-1])
        return optics.through_lens(self._lens, upright, first, rows, smooth=True)

    def _bent(self, drawn: Float32) -> Float32:
        """A drawn raster, bottom row first, through the lens without blending neighbours."""
        upright = np.ascontiguousarray(drawn[::-1])
        return optics.through_lens(
            self._lens, upright, 0, slice(0, self._params.height), smooth=False
        )

    def _own_stage(self) -> Stage:
        thread = threading.get_ident()
        if self._stage is None:
            self._stage = Stage(
                self._model, self._lens.raster, self._params.samples, self._vegetation
            )
            self.renderer, self._thread = self._stage.renderer, thread
        if self._thread != thread:
            raise RuntimeError(
                "a camera renders in one thread only: call close() there before another takes over"
            )
        return self._stage

    def _noise_place(self, tick: int) -> NoisePlace:
        rng = np.random.default_rng([*self._noise_key, tick])
        row, col = rng.integers(0, optics.NOISE_MARGIN + 1, size=2)
        return NoisePlace(int(row), int(col), int(2 * rng.integers(0, 2) - 1))


def _frozen(array: Any) -> Any:
    array.setflags(write=False)
    return array
