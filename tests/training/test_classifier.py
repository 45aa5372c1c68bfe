"""Loss, class weights and regularization against closed forms."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from wheretolook.inputs.channels import CHANNELS
from wheretolook.scorers.mlp.network import add_noise
from wheretolook.training.data import class_weights
from wheretolook.training.fit import weight_penalty, weighted_bce


def test_loss_equals_a_hand_computation():
    logits = torch.tensor([0.0, 2.0, -1.0, 0.5])
    labels = torch.tensor([1.0, 1.0, 0.0, 0.0])
    negative = 0.75
    positive = 1.5

    def p(logit):
        return 1 / (1 + math.exp(-logit))

    by_hand = -(
        positive * math.log(p(0.0))
        + positive * math.log(p(2.0))
        + negative * math.log(1 - p(-1.0))
        + negative * math.log(1 - p(0.5))
    )
    assert weighted_bce(logits, labels, (negative, positive)).item() == pytest.approx(by_hand / 4, rel=1e-6)


def test_loss_stays_finite_where_a_sigmoid_would_round_to_zero():
    loss = weighted_bce(torch.tensor([200.0, -200.0]), torch.tensor([0.0, 1.0]), (1.0, 1.0))
    assert loss.item() == pytest.approx(200.0)


def test_class_weights_balance_the_classes():
    negative, positive = class_weights(np.repeat([True, False], [3, 9]))
    assert (negative, positive) == pytest.approx((12 / 18, 12 / 6))
    assert 9 * negative == pytest.approx(3 * positive)
    assert (9 * negative + 3 * positive) / 12 == pytest.approx(1.0)


def test_penalty_sums_squared_weights_and_leaves_biases_out():
    network = nn.Sequential(nn.Linear(2, 2), nn.ReLU(), nn.Linear(2, 1))
    with torch.no_grad():
        network[0].weight.copy_(torch.tensor([[1.0, -2.0], [3.0, 0.5]]))
        network[2].weight.copy_(torch.tensor([[-1.0, 4.0]]))
        network[0].bias.fill_(100.0)
        network[2].bias.fill_(-50.0)
    penalty = weight_penalty(network)
    assert penalty.item() == pytest.approx(1 + 4 + 9 + 0.25 + 1 + 16)
    penalty.backward()
    assert network[0].bias.grad is None
    torch.testing.assert_close(network[2].weight.grad, 2 * network[2].weight.detach())


def test_noise_has_the_asked_scale_and_only_on_filled_bins():
    torch.manual_seed(0)
    means = torch.zeros(200, len(CHANNELS), 10, 10)
    filled = torch.zeros(200, 10, 10, dtype=torch.bool)
    filled[:, :5] = True
    noisy = add_noise(means, filled, noise_px=2.0, noise_m=0.1)
    assert torch.all(noisy[:, :, 5:] == 0)
    spread = noisy[:, :, :5].std((0, 2, 3))
    expected = torch.tensor([2.0 if name in "uv" else 0.1 for name in CHANNELS])
    torch.testing.assert_close(spread, expected, rtol=0.05, atol=0)
