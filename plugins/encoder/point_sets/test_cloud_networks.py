"""Properties of all networks on clouds: padding, parts of a batch, and what they refuse."""

import math

import pytest
import torch

from framework.configuration.schema import resolve
from framework.errors import ConfigError
from framework.geometry.clouds import pad
from plugins.encoder.point_sets import test_deepsets, test_dgcnn, test_pointnet, test_pointnet2

BUILDERS = {
    "deepsets": test_deepsets.build_encoder,
    "dgcnn": test_dgcnn.build_encoder,
    "pointnet": test_pointnet.build_encoder,
    "pointnet2": test_pointnet2.build_encoder,
}


@pytest.mark.parametrize("name", ["pointnet", "pointnet2", "dgcnn"])
def test_padding_does_not_enter_the_moments_of_batch_norm(name):
    clouds = [torch.randn(number, 3) for number in (9, 9, 9)]
    encoder, other = BUILDERS[name](), BUILDERS[name]()
    encoder.train()(torch.stack(clouds))
    other.train()(torch.cat([torch.stack(clouds), torch.full((3, 5, 3), math.nan)], 1))
    for key, value in encoder.state_dict().items():
        torch.testing.assert_close(other.state_dict()[key], value, msg=key)


@pytest.mark.parametrize(
    "name, config, numbers",
    [
        ("pointnet", {}, (3000, 2000, 2100, 10, 2999)),
        ("pointnet2", {"grouping": "multi_scale"}, (300, 20, 21, 10, 299)),
        ("dgcnn", {}, (700, 20, 21, 10, 699)),
    ],
)
def test_few_clouds_at_a_time_give_what_all_at_once_give(name, config, numbers):
    encoder = BUILDERS[name]((max(numbers), 3), **config)
    clouds = pad([torch.randn(number, 3) for number in numbers])
    whole = encoder(clouds)
    with torch.no_grad():
        torch.testing.assert_close(encoder(clouds), whole, rtol=1e-5, atol=1e-6)
        assert encoder(clouds[:0]).shape == (0, *encoder.output_shape)


@pytest.mark.parametrize("name", BUILDERS)
def test_refuses_attributes_that_are_not_there(name):
    with pytest.raises(ConfigError, match="the clouds have no such columns"):
        BUILDERS[name]((100, 3), attributes=True)


@pytest.mark.parametrize(
    "name, config",
    [
        *((name, config) for name in BUILDERS for config in ({"normalise": "ball"}, {"points": 0})),
        *(("deepsets", config) for config in ({"channels": []}, {"widths": [0]}, {"activation": "relu"})),
        *(
            ("pointnet", config)
            for config in ({"point_widths": [4, 4]}, {"widths": []}, {"variant": "plain"})
        ),
        *(
            ("dgcnn", config)
            for config in ({"neighbours": 0}, {"edge_widths": []}, {"point_width": 0}, {"widths": []})
        ),
        *(
            ("pointnet2", config)
            for config in ({"grouping": "both"}, {"centroids": [8]}, {"radius": 0}, {"width": 0})
        ),
    ],
    ids=str,
)
def test_refuses_a_config_out_of_range(name, config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        resolve("encoder", {"name": name, **config})
