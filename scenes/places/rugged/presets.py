"""Kinds of rugged ground: what their dials are set to, their relief and their materials.

``spectrum`` is the exponent b of the relief's power spectrum in two dimensions, |k|^-b. It was
fitted to the spectra, averaged over directions, of squares of real elevation models without their
mean plane, under a Hann window:

- 3.3: the natural hillside of the test model of CODEM (1 m cells, 4 to 64 m, mean slope 21 deg);
- 3.5: the Jacksboro fault, Tennessee (SRTM of USGS and NASA as in matplotlib, 93 m cells, 0.4 to
  6 km, median of six squares of 12 km): ridges, of which rock faces are taken to be smaller copies;
- 3.6: gullies of West Bijou Creek, Colorado (the tutorials of landlab, 5 m cells, 20 to 160 m);
- 3.0: lava, from the Hurst exponent H = 0.5 of Holuhraun (Aufaristama et al., Geosciences 10, 2020)
  by b = 2 H + 2.

Hillsides, step heights, depths, roughness and colours are assumed.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from touchdown.scenes.api import RuggedParams
from touchdown.scenes.authoring.ground import Ground


@dataclass(frozen=True, kw_only=True, slots=True)
class Preset:
    """One kind of ground."""

    slope_deg: float
    rock_abundance: float
    cover: str
    groove_fraction: float
    safe_fraction: float
    spectrum: float
    ground: Ground
    """where nothing else is"""
    patches: tuple[Ground, ...]
    """the second and the third most common material"""
    steep: Ground
    """of faces"""
    rock: Ground
    plane: float
    """part of the slope that the hillside has as a whole"""
    rough_m: float
    """standard deviation of what is finer than a metre"""
    terrace_m: float = 0.0
    """height of steps; 0: none"""
    terrace_part: float = 1.0
    """of the ground that has them"""
    gully_m: float = 0.0
    """depth of the largest gullies"""
    ridge_m: float = 0.0
    """height of pressure ridges and tumuli"""
    strata_m: float = 0.0
    """thickness of a pair of layers that the faces show"""
    ruts: bool = False
    """grooves are the ruts of vehicles, not crevices"""


PRESETS: Mapping[str, Preset] = {
    "upland": Preset(
        slope_deg=7.0, rock_abundance=0.03, cover="tussocks", groove_fraction=0.004,
        safe_fraction=0.12, spectrum=3.3, plane=0.6, rough_m=0.012, ground=Ground.ROUGH,
        patches=(Ground.HEATHER, Ground.DRY_GRASS), steep=Ground.SOIL, rock=Ground.GRANITE,
        terrace_m=1.1, terrace_part=0.25,
    ),
    "alpine": Preset(
        slope_deg=18.0, rock_abundance=0.12, cover="snow", groove_fraction=0.004,
        safe_fraction=0.05, spectrum=3.5, plane=0.75, rough_m=0.025, ground=Ground.SCREE,
        patches=(Ground.ROUGH, Ground.DRY_GRASS), steep=Ground.GRANITE, rock=Ground.GRANITE,
        terrace_m=2.2, terrace_part=0.45,
    ),
    "quarry": Preset(
        slope_deg=12.0, rock_abundance=0.06, cover="scree", groove_fraction=0.006,
        safe_fraction=0.10, spectrum=3.3, plane=0.65, rough_m=0.012, ground=Ground.LIMESTONE,
        patches=(Ground.GRAVEL, Ground.MUD), steep=Ground.LIMESTONE, rock=Ground.LIMESTONE,
        terrace_m=3.2, strata_m=0.7, ruts=True,
    ),
    "lava": Preset(
        slope_deg=8.0, rock_abundance=0.10, cover="bare", groove_fraction=0.02,
        safe_fraction=0.04, spectrum=3.0, plane=0.3, rough_m=0.035, ground=Ground.BASALT,
        patches=(Ground.MOSS, Ground.SCREE), steep=Ground.BASALT, rock=Ground.BASALT, ridge_m=1.1,
    ),
    "gully": Preset(
        slope_deg=14.0, rock_abundance=0.02, cover="scrub", groove_fraction=0.004,
        safe_fraction=0.08, spectrum=3.6, plane=0.5, rough_m=0.008, ground=Ground.BADLAND,
        patches=(Ground.DRY_GRASS, Ground.SAND_FLAT), steep=Ground.BADLAND, rock=Ground.BEDROCK,
        gully_m=3.2, strata_m=1.3,
    ),
    "felled_forest": Preset(
        slope_deg=9.0, rock_abundance=0.01, cover="logs", groove_fraction=0.03,
        safe_fraction=0.06, spectrum=3.3, plane=0.6, rough_m=0.02, ground=Ground.BRASH,
        patches=(Ground.FERN, Ground.LITTER), steep=Ground.SOIL, rock=Ground.GRANITE, ruts=True,
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Dials:
    """The dials of one scene: those set, and its preset's."""

    preset: Preset
    slope_deg: float
    relief_m: float | None
    rock_abundance: float
    cover: str
    groove_fraction: float
    safe_fraction: float

    @staticmethod
    def of(params: RuggedParams) -> "Dials":
        preset = PRESETS[params.preset]
        names = ("slope_deg", "rock_abundance", "groove_fraction", "safe_fraction")
        given = {name: getattr(params, name) for name in names}
        chosen = {k: getattr(preset, k) if v is None else v for k, v in given.items()}
        cover = params.cover or preset.cover
        return Dials(preset=preset, relief_m=params.relief_m, cover=cover, **chosen)
