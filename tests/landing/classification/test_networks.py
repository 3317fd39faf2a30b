"""Networks of ground classification: sizes as published, attention as its equations say."""

from typing import Any

import numpy as np
import pytest

torch: Any = pytest.importorskip("torch")

from touchdown.landing.classification.networks import blocks, resnet  # noqa: E402
from touchdown.landing.classification.networks.registry import NETWORKS, build_network  # noqa: E402

PUBLISHED = {
    "resnet18": 11_689_512, "resnet34": 21_797_672, "resnet50": 25_557_032, "resnet101": 44_549_160,
    "resnext50": 25_028_904, "vgg19": 143_667_240, "mobilenet_v3_large": 5_483_032,
    "inception_v4": 42_679_816, "resnet50_cbam": 28_089_624, "efficientnet_lite0": 4_652_008,
}  # fmt: skip
"""weights for 1000 classes; Woo et al. print 28.09 M for the last one"""


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def _count(network: Any) -> int:
    return sum(weights.numel() for weights in network.parameters())


@pytest.mark.parametrize("name", NETWORKS)
def test_number_of_weights_is_as_published(name: str) -> None:
    with torch.device("meta"):
        assert _count(build_network(name, 1000, 224)) == PUBLISHED[name]


@pytest.mark.parametrize("name", NETWORKS)
def test_statistics_of_the_norms_arrive_within_a_short_training(name: str) -> None:
    """0.9 to the power of 200 steps is left of what they began with; at a momentum of 0.01, as
    MobileNetV3's authors have it for hundreds of epochs, it would be an eighth."""
    with torch.device("meta"):
        network = build_network(name, 7, 96).eval()
        assert network(torch.zeros(2, 3, 96, 96)).shape == (2, 7)  # small pictures go through
    norms = [part for part in network.modules() if isinstance(part, torch.nn.BatchNorm2d)]
    assert all(norm.momentum == 0.1 for norm in norms) and bool(norms) == (name != "vgg19")


def test_channel_attention_by_hand() -> None:
    """Means 2 and 0, maximum 4 and 0; the MLP doubles: sigmoid(2 (2 + 4)) and sigmoid(0)."""
    features = torch.tensor([[[[1.0, 1.0], [2.0, 4.0]], [[0.0, 0.0], [0.0, 0.0]]]])
    weights = resnet.channel_attention(features, lambda pooled: 2.0 * pooled)
    assert weights.shape == (1, 2, 1, 1)
    np.testing.assert_allclose(weights.ravel(), [1.0 / (1.0 + np.exp(-12.0)), 0.5], rtol=1e-6)


def test_spatial_attention_by_hand() -> None:
    """Over two channels: means 2 and -1, maximum 3 and 1; the window takes their difference."""
    features = torch.tensor([[[[1.0, 1.0]], [[3.0, -3.0]]]])
    weights = resnet.spatial_attention(features, lambda pools: pools[:, 1:] - pools[:, :1])
    assert weights.shape == (1, 1, 1, 2)
    expected = 1.0 / (1.0 + np.exp([-1.0, -2.0]))
    np.testing.assert_allclose(weights.ravel(), expected, rtol=1e-6)


def test_space_is_attended_after_channels() -> None:
    """Eq. 1: the spatial pools see features that the channels have scaled already."""
    features = torch.tensor([[[[2.0]], [[4.0]]]])
    seen = []

    def window(pools: Any) -> Any:
        seen.append(pools)
        return torch.zeros(1, 1, 1, 1)

    result = resnet.attend(features, lambda pooled: torch.zeros_like(pooled), window)
    np.testing.assert_allclose(seen[0].ravel(), [1.5, 2.0])
    np.testing.assert_allclose(result.ravel(), [0.5, 1.0])


def test_the_window_looks_seven_pixels_across() -> None:
    module: Any = resnet.Cbam(16).eval()
    with torch.no_grad():
        module.window[0].weight.fill_(1.0)
        pools = torch.zeros(1, 2, 15, 15)
        pools[0, 0, 7, 7] = 1.0
        reached = module.window(pools)[0, 0] > 0.5
    rows, cols = np.nonzero(reached.numpy())
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (4, 10, 4, 10)


@pytest.mark.parametrize("side", [3, 4, 7, 10])
def test_mean_grid_is_adaptive_pooling(side: int) -> None:
    features = torch.rand(2, 3, side, side, generator=torch.Generator().manual_seed(1))
    expected = torch.nn.functional.adaptive_avg_pool2d(features, 7)
    np.testing.assert_allclose(blocks.MeanGrid(side, 7)(features), expected, atol=1e-6)


def test_small_images_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 32 pixels"):
        build_network("resnet18", 7, 16)
