import math

import numpy as np
import pytest
import torch
from scipy.special import ndtr

from framework.configuration.schema import build, resolve
from framework.errors import UserError
from framework.geometry.clouds import normalise_clouds
from framework.testing.cloud_encoders import batch_of


def build_encoder(shape=(40, 3), **config):
    return build("encoder", resolve("encoder", {"name": "point_nn", **config}), input_shape=shape)


def encoding(position, length, frequency, base):
    """Return the encoding of one position, number by number."""
    numbers = []
    for coordinate in position:
        for d in range(length // 6):
            phase = frequency * coordinate / base ** (6 * d / length)
            numbers += [math.sin(phase), math.cos(phase)]
    return np.array(numbers)


def features_by_loops(cloud, points, width, stages, neighbours, frequency, base):
    """Return the features of a normalised cloud by the paper's formulas, point by point, in NumPy."""
    chosen = [int(np.argmax(((cloud - cloud.mean(0)) ** 2).sum(1)))]
    while len(chosen) < min(points, len(cloud)):
        chosen.append(int(np.argmax(np.min([((cloud - cloud[i]) ** 2).sum(1) for i in chosen], 0))))
    positions = cloud[chosen]
    features = np.stack([encoding(position, width, frequency, base) for position in positions])
    for _ in range(stages):
        count = max(len(positions) // 2, 1)
        near = [np.argsort(((positions - positions[i]) ** 2).sum(1))[:neighbours] for i in range(count)]
        offset = np.stack([positions[near[i]] - positions[i] for i in range(count)])
        relative = np.stack([features[near[i]] - features[i] for i in range(count)])
        offset, relative = offset / (offset.std() + 1e-5), relative / (relative.std() + 1e-5)
        pooled = []
        for i in range(count):
            rows = []
            for j in range(len(near[i])):
                wave = encoding(offset[i, j], 2 * features.shape[1], frequency, base)
                rows.append((np.concatenate([relative[i, j], features[i]]) + wave) * wave)
            both = np.max(rows, 0) + np.mean(rows, 0)
            pooled.append(both * ndtr(both))
        positions, features = positions[:count], np.stack(pooled)
    return features.max(0) + features.mean(0)


@pytest.mark.parametrize("points, stages", [(40, 1), (40, 3), (25, 2), (3, 4)])
def test_features_agree_with_loops_over_points(points, stages):
    settings = {
        "points": points,
        "width": 12,
        "stages": stages,
        "neighbours": 7,
        "frequency": 30.0,
        "base": 50.0,
    }
    clouds = batch_of([40, 11], 3, torch.float64)
    features = build_encoder(**settings)(clouds)
    local = normalise_clouds(clouds, "unit_ball").clouds.numpy()
    for number, length in enumerate([40, 11]):
        expected = features_by_loops(local[number, :length], **settings)
        np.testing.assert_allclose(features[number].numpy(), expected, rtol=1e-9, atol=1e-9)


def test_published_settings_give_the_published_length_and_tell_shapes_apart():
    encoder = build_encoder((512, 3))
    assert encoder.output_shape == (1152,)
    assert not list(encoder.parameters())
    torch.manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(4, 512, 3), dim=-1)
    cube = torch.rand(4, 512, 3) * 2 - 1
    axis = torch.randint(3, (4, 512, 1))
    cube = cube.scatter(2, axis, cube.gather(2, axis).sign())  # onto the surface
    features = torch.nn.functional.normalize(encoder(torch.cat([ball, cube])), dim=1)
    alike = features @ features.T
    between = alike[:4, 4:].max()
    assert all(
        alike[rows, rows][~torch.eye(4, dtype=bool)].min() > between for rows in (slice(4), slice(4, 8))
    )


@pytest.mark.parametrize("width", [0, 10])
def test_a_width_that_holds_no_whole_number_of_sines_is_refused(width):
    with pytest.raises(UserError, match="width"):
        build_encoder(width=width)
