"""Training of a model on examples, with cross-validation on held-out recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.scenes.examples import MeasuredExample
from sceneslam.scenes.model import Model, fit, shares
from sceneslam.types.errors import InputError

_IMAGES_PER_SCENE = 10.0  # effective number: neighbouring images are similar
_TEMPERATURES = np.geomspace(1.0, 10.0, 65)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged:
    """An example with the logits of a model that was not trained on it."""

    seen: MeasuredExample
    scenes: tuple[str, ...]
    scores: NDArray[np.float64]  # (N, S)

    @property
    def probabilities(self) -> NDArray[np.float64]:
        """Return the probabilities (N, S) of the scenes."""
        return shares(self.scores)

    @property
    def votes(self) -> NDArray[np.str_]:
        """Return (N,) the most probable scenes."""
        return np.array([self.scenes[place] for place in self.scores.argmax(axis=1)])

    @property
    def is_right(self) -> NDArray[np.bool_]:
        """Return (N,) whether the vote is the example's scene."""
        return np.asarray(self.votes == self.seen.example.scene)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trained:
    """A model, and the results of such models on held-out recordings."""

    model: Model
    held_out: Sequence[Judged]  # empty if no recording could be held out
    temperature: float

    @property
    def never_held_out(self) -> tuple[str, ...]:
        """Return the scenes for which there is no result on a held-out recording."""
        held_out = _scenes([one.seen for one in self.held_out])
        return tuple(scene for scene in self.model.scenes if scene not in held_out)


def train(all_seen: Sequence[MeasuredExample], names: Sequence[str]) -> Trained:
    """Return the model of examples whose features have these names.

    Its probabilities are calibrated on held-out groups of recordings: all groups without which
    every scene still has an example. Raises InputError for fewer than two scenes.
    """
    if len({seen.example.scene for seen in all_seen}) < 2:
        raise InputError("examples: of two scenes or more")
    held_out: list[Judged] = []
    for group in dict.fromkeys(seen.example.group for seen in all_seen):
        inside = [seen for seen in all_seen if seen.example.group == group]
        others = [seen for seen in all_seen if seen.example.group != group]
        if _scenes(others) == _scenes(all_seen):
            model = _fit(others, names)
            held_out += [judge(model, seen) for seen in inside]
    temperature = _temperature(held_out)
    cooled = [
        Judged(seen=one.seen, scenes=one.scenes, scores=one.scores / temperature)
        for one in held_out
    ]
    model = _fit(all_seen, names).cooled(temperature)
    return Trained(model=model, held_out=cooled, temperature=temperature)


def judge(model: Model, seen: MeasuredExample) -> Judged:
    """Return a model's result for an example."""
    return Judged(seen=seen, scenes=model.scenes, scores=model.scores(seen.features))


def _scenes(all_seen: Sequence[MeasuredExample]) -> set[str]:
    return {seen.example.scene for seen in all_seen}


def _fit(all_seen: Sequence[MeasuredExample], names: Sequence[str]) -> Model:
    labels = [seen.example.scene for seen in all_seen for _ in seen.features]
    features = np.concatenate([seen.features for seen in all_seen])
    return fit(features, labels, _weights(all_seen), names)


def _weights(all_seen: Sequence[MeasuredExample]) -> NDArray[np.float64]:
    """Return the weights (N,) of all images.

    All scenes have the same weight, and so have all examples of a scene, unless they have weights
    of their own, by which a scene where more is gained is more probable.
    """
    total = _IMAGES_PER_SCENE * len(_scenes(all_seen))
    weights = np.concatenate([seen.weights for seen in all_seen])
    if all(seen.example.is_weighted for seen in all_seen) and weights.any():
        return np.asarray(total * weights / weights.sum())
    parts = []
    for seen in all_seen:
        examples = sum(other.example.scene == seen.example.scene for other in all_seen)
        count = len(seen.features)
        parts.append(np.full(count, _IMAGES_PER_SCENE / examples / count))
    return np.concatenate(parts)


def _temperature(held_out: Sequence[Judged]) -> float:
    """Return the temperature for which the held-out scenes have the largest likelihood.

    Images have the weights of the training.
    The logits are divided by it, which changes no vote (temperature scaling; Guo et al., ICML
    2017). It is at least 1: a few correct recordings are no reason for more certainty than the fit
    has.
    """
    if not held_out:
        return 1.0
    weights = _weights([one.seen for one in held_out])
    losses = [
        weights @ np.concatenate([_losses(one, temperature) for one in held_out])
        for temperature in _TEMPERATURES
    ]
    return float(_TEMPERATURES[int(np.argmin(losses))])


def _losses(one: Judged, temperature: float) -> NDArray[np.float64]:
    """Return (N,) the negative log-likelihood of the true scene."""
    true = shares(one.scores / temperature)[:, one.scenes.index(one.seen.example.scene)]
    return np.asarray(-np.log(np.maximum(true, 1e-12)))
