"""Density heads with one planted fault each; `mode=check` must find nearly all of them."""

import math

import torch
from torch.distributions import constraints

from framework.distributions.circular import circular, wrap
from framework.distributions.protocol import arc_probability, cdf, marginal, marginal_cdfs
from plugins.density_head.gaussian.density import Gaussian
from plugins.density_head.von_mises.density import VonMises
from tests import planted_answers as wrong
from tests.planted_heads import CLASSES, GREY, HEIGHT, IMAGE, NO_CASES, ONE, PLACE, THREE, TWO, Fault, Halved

ALL_FAULTS = (
    # one angle
    Fault("normaliser 1e-3 off for κ > 1e4", ONE, {"log_prob": wrong.off(1e-3, lambda k: k > 1e4)}),
    Fault("normaliser 0.1 nat off for κ < 0.01", ONE, {"log_prob": wrong.off(0.1, lambda k: k < 0.01)}),
    Fault("log_prob in bits", ONE, {"log_prob": lambda d, v: d.log_prob(v) / math.log(2)}),
    Fault(
        "κ's gradient flips sign for κ > 1e4",
        ONE,
        {"loss": wrong.with_slope(-1, lambda k: k > 1e4)},
        "loss gradient",
    ),
    Fault(
        "κ's gradient is 1 % small for κ < 0.05",
        ONE,
        {"loss": wrong.with_slope(0.99, lambda k: k < 0.05)},
        "loss gradient",
    ),
    Fault(
        "κ has no gradient for κ > 1e6",
        ONE,
        {"loss": wrong.with_slope(0, lambda k: k > 1e6)},
        "loss gradient",
    ),
    Fault("sampler caps κ at 1e3", ONE, {"sample": wrong.capped}, "samples follow log_prob"),
    Fault("sampler 0.2 deviations off", ONE, {"sample": lambda d, s: d.sample(s) + 0.2 * wrong.width(d)}),
    Fault(
        "sampler a tenth too wide for κ > 100",
        ONE,
        {
            "sample": lambda d, s: VonMises(
                d.location, torch.where(d.concentration > 100, d.concentration / 1.21, d.concentration)
            ).sample(s)
        },
        "samples follow log_prob",
    ),
    Fault(
        "sampler leaves out the arc beyond ±3", ONE, {"sample": lambda d, s: wrap(d.sample(s)).clamp(-3, 3)}
    ),
    Fault("entropy 0.1 nat off", ONE, {"entropy": lambda d: d.entropy() + 0.1}, "entropy"),
    Fault(
        "entropy 1e-3 off for κ > 1e4",
        ONE,
        {"entropy": lambda d: d.entropy() + 1e-3 * (d.concentration[..., 0] > 1e4)},
        "entropy",
    ),
    Fault(
        "entropy is NaN for κ > 1e6",
        ONE,
        {"entropy": lambda d: torch.where(d.concentration[..., 0] > 1e6, math.nan, d.entropy())},
        "entropy",
    ),
    Fault("mode π off where |μ| > 3", ONE, {"mode": lambda d: d.mode + math.pi * (d.mode.abs() > 3)}, "mode"),
    Fault("mode half a deviation off", ONE, {"mode": lambda d: d.mode + 0.5 * wrong.width(d)}, "mode"),
    Fault("median 0.1 deviations off", ONE, {"median": lambda d, n: d.mode + 0.1 * wrong.width(d)}, "median"),
    Fault(
        "median is the antipode where |μ| > 2",
        ONE,
        {"median": lambda d, n: d.mode + math.pi * (d.mode.abs() > 2)},
        "median",
    ),
    Fault("log_prob ends at ±π", ONE, {"log_prob": lambda d, v: d.log_prob(v.clamp(-math.pi, math.pi))}),
    Fault(
        "log_prob drifts with the turns",
        ONE,
        {"log_prob": lambda d, v: d.log_prob(v) + 1e-3 * ((v - wrap(v)).abs() > 1).sum(-1)},
    ),
    Fault(
        "log_prob wrong at ±π itself",
        ONE,
        {"log_prob": lambda d, v: d.log_prob(v) + (v.abs() == math.pi).sum(-1)},
        "2π-periodic",
        {"concentration": "fixed"},
    ),
    Fault("half precision inside, of float32 only", ONE, {"log_prob": wrong.in_half}),
    Fault(
        "3e-6 off in float32 only",
        ONE,
        {"log_prob": lambda d, v: d.log_prob(v) * (1 + 3e-6 * (d.location.dtype == torch.float32))},
        "log_prob, float32",
    ),
    Fault(
        "2e-5 off in float32 for κ > 1e4 only",
        ONE,
        {
            "log_prob": lambda d, v: (
                d.log_prob(v)
                * (1 + 2e-5 * (d.concentration[..., 0] > 1e4) * (d.location.dtype == torch.float32))
            )
        },
    ),
    Fault(
        "κ a hundredth large, in everything",
        ONE,
        {"forward": lambda h, r: h.sound(torch.where(r.abs() < 1e30, 1.01 * r, r))},
    ),
    Fault(
        "a batch of shape () has one row",
        ONE,
        {"forward": lambda h, r: h.sound(r.reshape(-1, r.shape[-1]) if r.dim() == 1 else r)},
        "batch shapes",
    ),
    Fault(
        "an empty batch raises",
        ONE,
        {"forward": wrong.refusing(lambda r: r.numel() == 0, "empty")},
        "batch shapes",
    ),
    Fault("says that angles are reals", ONE, {"support": lambda d: constraints.real_vector}),
    Fault("NaN for κ > 1e8", ONE, {"log_prob": wrong.nan_far}),
    Fault(
        "raises for raw numbers beyond 1e15",
        ONE,
        {
            "forward": wrong.refusing(
                lambda r: bool((r.abs() > 1e15).any()) and bool(r.isfinite().all()), "too large"
            )
        },
        "finite for any raw parameters",
    ),
    Fault("depends on its neighbours in the batch", ONE, {"forward": wrong.batch_wide}),
    Fault("float64 becomes float32", ONE, {"log_prob": lambda d, v: d.log_prob(v).float()}),
    Fault(
        "half precision is not upcast",
        ONE,
        {"forward": lambda h, r: Halved(h.sound(r)) if r.dtype == torch.float16 else h.sound(r)},
        "number types",
    ),
    Fault("NaN is accepted", ONE, {"forward": wrong.accepting}, "NaN and infinity refused"),
    Fault(
        "NaN is refused without naming the row", ONE, {"forward": wrong.nameless}, "NaN and infinity refused"
    ),
    Fault("state kept between calls", ONE, {"forward": wrong.remembering}),
    Fault("samples heed no seed", ONE, {"sample": wrong.unseeded}),
    Fault(
        "a number that is not stored",
        ONE,
        {"forward": lambda h, r: h.sound(r * (1 + 1e-9 * h.offset) + 1e-3 * h.offset)},
    ),
    Fault(
        "loss punishes large κ",
        ONE,
        {"loss": lambda h, r, t: -h(r).log_prob(t) + 0.1 * (1 + h(r).concentration[..., 0]).log()},
        "loss is least for its own density",
    ),
    Fault(
        "loss of the mirrored angle",
        ONE,
        {"loss": lambda h, r, t: -h(r).log_prob(-t)},
        "loss is least for its own density",
    ),
    Fault("loss is constant", ONE, {"loss": lambda h, r, t: 0 * r.sum(-1) + 0 * t.sum(-1) + 1}),
    Fault(
        "calibrate makes it worse",
        ONE,
        {"calibrate": wrong.worse},
        "calibrate does not harm",
        {"concentration": "fixed"},
    ),
    Fault(
        "calibrate changes a parameter",
        ONE,
        {"calibrate": wrong.changes_parameter},
        "state-dict round trip",
        {"concentration": "fixed"},
    ),
    Fault(
        "another density as a component",
        ONE,
        {"forward": wrong.doubled_when_stacked},
        "mixture of one equals the component",
    ),
    Fault("knobs descend", ONE, {"knobs": lambda: {"samples": (3, 1)}}, "knobs can be set"),
    Fault(
        "arc of the density at half κ",
        ONE,
        {"arc_probability": lambda d, a, b: arc_probability(VonMises(d.location, d.concentration / 2), a, b)},
        "cdf",
    ),
    Fault(
        "1e-9 off, in everything",
        ONE,
        {"log_prob": lambda d, v: d.log_prob(v) * (1 + 1e-9)},
        "log_prob, float64",
    ),
    Fault(
        "half precision inside, without a reference",
        ONE,
        {"log_prob": wrong.in_half},
        "float32 against float64",
        NO_CASES,
    ),
    Fault(
        "four rows know each other",
        ONE,
        {"forward": wrong.four_know_each_other},
        "batch rows are independent",
    ),
    Fault(
        "loss counts predictions",
        ONE,
        {"forward": wrong.counting, "loss": wrong.counted_loss},
        "same seed, same bits",
    ),
    # two and three angles
    Fault(
        "joint 0.1 nat off for κ > 1e3, with the entropy that fits",
        THREE,
        {"log_prob": wrong.off(0.1, lambda k: k > 1e3), "entropy": wrong.lower_for_narrow},
        "integral by draws",
        NO_CASES,
    ),
    Fault("marginals exchanged", TWO, {"marginal": lambda d, i: marginal(d, 1 - i)}),
    Fault(
        "marginal at κ 1 % large",
        TWO,
        {
            "marginal": lambda d, i: VonMises(
                d.location[..., i : i + 1], 1.01 * d.concentration[..., i : i + 1]
            )
        },
        "marginals",
    ),
    Fault(
        "marginal wrong for κ > 1e3",
        TWO,
        {
            "marginal": lambda d, i: VonMises(
                d.location[..., i : i + 1], d.concentration[..., i : i + 1].clamp(max=1e3)
            )
        },
        "samples follow marginals",
    ),
    Fault("joint 0.1 nat off for κ > 1e3", THREE, {"log_prob": wrong.off(0.1, lambda k: k > 1e3)}),
    # one and two reals
    Fault("log-density 0.1 nat off for σ > 20", HEIGHT, {"log_prob": wrong.off(0.1, lambda s: s > 20)}),
    Fault("log-density 0.1 nat off for σ < 0.01", HEIGHT, {"log_prob": wrong.off(0.1, lambda s: s < 0.01)}),
    Fault(
        "log-density NaN beyond 9 σ",
        HEIGHT,
        {
            "log_prob": lambda d, v: torch.where(
                ((v - d.mean) / d.scale).abs()[..., 0] > 9, math.nan, d.log_prob(v)
            )
        },
    ),
    Fault(
        "tails cut off at 3 σ",
        HEIGHT,
        {
            "log_prob": lambda d, v: Gaussian(d.location, d.scale).log_prob(
                d.mean + (v - d.mean).clamp(-3 * d.scale, 3 * d.scale)
            )
        },
    ),
    Fault("every row draws the same noise", HEIGHT, {"sample": wrong.shared_noise}, "draws are independent"),
    Fault("sampler uniform, of the right variance", HEIGHT, {"sample": wrong.laplace}),
    Fault("variance is the deviation", HEIGHT, {"variance": lambda d: d.scale}, "mean and variance"),
    Fault(
        "mean 0.01 deviations off",
        HEIGHT,
        {"mean": lambda d: d.location + 0.01 * d.scale},
        "mean and variance",
    ),
    Fault(
        "cdf falls beyond 2 σ",
        HEIGHT,
        {"cdf": lambda d, v: cdf(d, d.location + 2 * d.scale - (v - d.location - 2 * d.scale).abs())},
        "cdf",
    ),
    Fault(
        "entropy without the scale",
        HEIGHT,
        {"entropy": lambda d: d.entropy() - d.scale.log().sum(-1)},
        "entropy",
    ),
    Fault(
        "median 0.1 deviations off, of a real",
        HEIGHT,
        {"median": lambda d, n: d.location + 0.1 * d.scale},
        "median",
    ),
    Fault(
        "mode a deviation off for σ > 20",
        HEIGHT,
        {"mode": lambda d: d.mode + d.scale * (d.scale > 20)},
        "mode",
    ),
    Fault("says that reals are angles", HEIGHT, {"support": lambda d: circular}),
    Fault(
        "sampler draws both numbers alike",
        PLACE,
        {"sample": wrong.second_as_first},
        "samples follow log_prob",
    ),
    Fault("sampler leaves out the second number", PLACE, {"sample": wrong.no_second}),
    Fault(
        "log-density without the second scale",
        PLACE,
        {"log_prob": lambda d, v: d.log_prob(v) + d.scale[..., 1].log()},
    ),
    Fault("mode with the numbers exchanged", PLACE, {"mode": lambda d: d.mode.flip(-1)}, "mode"),
    Fault("entropy of the first number", PLACE, {"entropy": wrong.first_only}, "entropy"),
    Fault(
        "normaliser 3e-6 off, with the entropy that fits",
        PLACE,
        {"log_prob": wrong.off(3e-6, wrong.everywhere), "entropy": wrong.fitting_entropy},
        "integral",
    ),
    # images
    Fault(
        "image 0.1 nat off, with the entropy that fits",
        IMAGE,
        {"log_prob": lambda d, v: d.log_prob(v) + 0.1, "entropy": lambda d: d.entropy() - 0.1},
        "integral by draws",
        {"scale": "number"},
    ),
    Fault(
        "each number of an image at half its scale",
        GREY,
        {"marginal_cdfs": lambda d, v: marginal_cdfs(d, d.location + 2 * (v - d.location))},
        "cdf",
        {"scale": "number"},
    ),
    # classes
    Fault("probabilities that do not add up", CLASSES, {"log_prob": wrong.smoothed}),
    Fault("never draws the last class", CLASSES, {"sample": wrong.below_labels}),
    Fault(
        "draws every class alike",
        CLASSES,
        {"sample": lambda d, s: torch.randint(3, (*s, *d.batch_shape), device=d.logits.device)},
        "samples follow log_prob",
    ),
    Fault("entropy in bits", CLASSES, {"entropy": lambda d: d.entropy() / math.log(2)}, "entropy"),
    Fault("mode is the least likely class", CLASSES, {"mode": lambda d: d.logits.argmin(-1)}, "mode"),
    Fault("labels from 1", CLASSES, {"enumerate_support": lambda d, e: d.enumerate_support(e) + 1}),
    Fault(
        "loss of the next class",
        CLASSES,
        {"loss": lambda h, r, t: -h(r).log_prob((t + 1) % 3)},
        "loss is least for its own density",
    ),
)
