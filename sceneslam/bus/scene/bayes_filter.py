"""A recursive Bayes filter over scenes: a hidden Markov model of the votes.

The state is the scene, which changes as a continuous-time Markov chain; a vote is its measurement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.scene.scene_filter import ConfirmedScene
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, SceneVote
from sceneslam.types.ranges import check_above


@dataclass(slots=True, kw_only=True)
class BayesSettings:
    """The hidden Markov model, and when a scene counts as confirmed."""

    mean_dwell_s: float  # a scene lasts this long on average
    error_ratio: float  # share of votes that are noise, independent of the scene
    correlation_s: float  # votes within this time count together as one measurement
    confirm_probability: float  # of a scene to be confirmed

    def __post_init__(self) -> None:
        check_above(0, mean_dwell_s=self.mean_dwell_s, correlation_s=self.correlation_s)
        if not 0 < self.error_ratio < 1:
            raise ConfigError("error_ratio", self.error_ratio, "above 0 and below 1")
        if not 0.5 < self.confirm_probability < 1:
            allowed = "above 0.5, so that it is the most probable scene, and below 1"
            raise ConfigError("confirm_probability", self.confirm_probability, allowed)


class BayesFilter:
    """Confirms another scene once its posterior probability is high enough.

    A vote with likelihoods is weighed by them; a vote without counts as certain of its scene. In
    both cases a share `error_ratio` of the votes is assumed to be noise. Votes within one
    `correlation_s` share the weight of one measurement, so that a higher frame rate does not add
    certainty.
    """

    def __init__(self, scenes: Sequence[str], settings: BayesSettings) -> None:
        self._settings = settings
        self._places = {scene: place for place, scene in enumerate(scenes)}
        self._belief = np.full(len(scenes), 1.0 / len(scenes))
        self._last_ns: int | None = None
        # Page's cumulative sum (CUSUM) per scene: the log-likelihood ratio of the scene to the
        # confirmed one, summed since the vote at which it began to grow.
        self._evidence = np.zeros(len(scenes))
        self._began_ns = np.zeros(len(scenes), np.int64)
        self._scene: str | None = None  # confirmed last, None before the first

    @property
    def posterior(self) -> Mapping[str, float] | None:
        """Return the probability of every scene after the last vote."""
        return dict(zip(self._places, self._belief.tolist(), strict=True))

    def update(self, vote: SceneVote) -> ConfirmedScene | None:
        """Return the scene that this vote confirms, None when nothing changes."""
        if vote.scene == UNSURE:
            return None
        elapsed_s = np.inf if self._last_ns is None else (vote.stamp_ns - self._last_ns) * 1e-9
        self._last_ns = vote.stamp_ns
        log_likelihoods = self._log_likelihoods(vote, elapsed_s)
        self._predict(elapsed_s)
        self._correct(log_likelihoods)
        self._accumulate(log_likelihoods, vote.stamp_ns)
        return self._confirmed(vote.stamp_ns)

    def _log_likelihoods(self, vote: SceneVote, elapsed_s: float) -> NDArray[np.float64]:
        """Return log P(vote | scene), shape (S,): a mixture of the vote's likelihood and noise."""
        likelihood_of = vote.likelihoods or {vote.scene: 1.0}
        likelihoods = np.array([likelihood_of.get(scene, 0.0) for scene in self._places])
        likelihoods /= likelihoods.sum()
        noise = self._settings.error_ratio
        mixed = (1.0 - noise) * likelihoods + noise / len(likelihoods)
        return np.asarray(np.log(mixed) * min(elapsed_s / self._settings.correlation_s, 1.0))

    def _predict(self, elapsed_s: float) -> None:
        """Predict the belief: the Markov chain's transition matrix is exp(Q t), symmetric."""
        count = len(self._belief)
        if count == 1:
            return
        rate_hz = count / (count - 1) / self._settings.mean_dwell_s
        even = 1.0 / count
        self._belief = even + (self._belief - even) * np.exp(-rate_hz * elapsed_s)

    def _correct(self, log_likelihoods: NDArray[np.float64]) -> None:
        """Update the belief by the vote (Bayes' rule)."""
        self._belief = self._belief * np.exp(log_likelihoods - log_likelihoods.max())
        self._belief /= self._belief.sum()

    def _accumulate(self, log_likelihoods: NDArray[np.float64], stamp_ns: int) -> None:
        """Update, per scene, since when the votes have supported it over the confirmed scene."""
        confirmed = 0.0 if self._scene is None else log_likelihoods[self._places[self._scene]]
        begins = self._evidence <= 0.0
        self._began_ns[begins] = stamp_ns
        self._evidence = np.maximum(self._evidence + log_likelihoods - confirmed, 0.0)

    def _confirmed(self, stamp_ns: int) -> ConfirmedScene | None:
        place = int(np.argmax(self._belief))
        scene = list(self._places)[place]
        if scene == self._scene or self._belief[place] < self._settings.confirm_probability:
            return None
        previous, self._scene = self._scene, scene
        self._evidence[:] = 0.0
        since_ns = int(self._began_ns[place])
        return ConfirmedScene(stamp_ns=stamp_ns, since_ns=since_ns, scene=scene, previous=previous)
