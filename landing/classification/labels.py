"""The two label schemes of ground."""

from touchdown.scenes.api import LAND_CLASSES

D_LAND: tuple[str, ...] = LAND_CLASSES
"""the paper's seven classes by landing difficulty"""

D_SCENE: tuple[str, ...] = (
    "airport", "bareland", "baseballfield", "beach", "bridge", "center", "church", "commercial",
    "denseresidential", "desert", "farmland", "forest", "industrial", "meadow",
    "mediumresidential", "mountain", "park", "parking", "playground", "pond", "port",
    "railwaystation", "resort", "river", "school", "sparseresidential", "square", "stadium",
    "storagetanks", "viaduct",
)  # fmt: skip
"""the thirty classes of AID (Xia et al., IEEE TGRS 2017)"""

SCHEMES: dict[str, tuple[str, ...]] = {"d_land": D_LAND, "d_scene": D_SCENE}
NO_LABEL = -1
"""label of an image whose class is not part of a scheme"""
