"""The paper's whole system in the closed loop: positioning, selection and network."""

from touchdown.experiments.config.loading import load_config
from touchdown.experiments.flight.run import fly

SEED = 8301


def test_the_whole_system_lands_in_field() -> None:
    """Bounds of 1.5 times the errors over crossroad of the edition that is kept, which images of a
    quarter of the pixels keep; without the LIDAR's pose it finds no site."""
    quick = ("camera.width=424", "camera.height=240", "landing.touchdown_speed_mps=0.3")
    asked = ("preset=short", "scene_seed=0", "sim.threads=1", "landing.selector=zou2024", *quick)
    options = {"scene": "crossroad", "estimator": "zou2024", "seed": SEED, "record": False}
    result = fly(load_config(None, asked, **options), None).plain()
    assert result["outcome"] == "LANDED" and result["landing"]["safe"]
    assert result["landing"]["judged_on"] == "geometry and class"
    assert result["choice"]["selector"] == "zou2024"
    assert result["choice"]["candidates"][0]["class_predicted"] == "lawn"
    assert result["position_error_m"]["mean"] < 0.12
    assert result["nees"]["median"] < 5.0
