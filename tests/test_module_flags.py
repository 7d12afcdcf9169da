import pytest
from torch import nn

from framework.calibration.module_flags import set_flag


def network():
    return nn.Sequential(
        nn.Linear(2, 2), nn.Dropout(0.1), nn.Sequential(nn.Dropout1d(0.2), nn.BatchNorm1d(2))
    )


@pytest.mark.parametrize("kinds", [nn.Dropout, (nn.Dropout, nn.Dropout1d)])
def test_a_flag_of_some_kinds_alone_and_only_for_a_while(kinds):
    model = network().eval()
    model[1].train()
    before = [layer.training for layer in model.modules()]
    with set_flag(model, kinds, "training", True):
        assert [layer.training for layer in model.modules() if isinstance(layer, kinds)] == [True] * (
            len(kinds) if isinstance(kinds, tuple) else 1
        )
        assert not model[2][1].training and not model[0].training
    assert [layer.training for layer in model.modules()] == before


def test_an_error_restores_it_too():
    model = network()
    with pytest.raises(ZeroDivisionError), set_flag(model, nn.BatchNorm1d, "track_running_stats", False):
        assert not model[2][1].track_running_stats
        _ = 1 / 0
    assert model[2][1].track_running_stats
