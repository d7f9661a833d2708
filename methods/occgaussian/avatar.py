"""The avatar: GauHuman's Gaussians whose attributes a decoder completes from features, own or asked for.

A Gaussian belongs to the vertex that it takes its skinning weights from. Where training views show that vertex it
has its own colour and the vertex's feature; where none does, both come from seen vertices by a `Query`. At rest,
without a training view, features are those in memory: all of this is computed once for all cameras and poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.body import Body
from ihbench.fit.big_pose.avatar import VERTEX, BigPoseAvatar
from ihbench.fit.big_pose.deformation import Posed
from ihbench.fit.decoded_cache import DecodedCache
from ihbench.fit.gaussians.harmonics import DC, REST, Y00
from ihbench.fit.gaussians.posed import PosedGaussians
from ihbench.fit.gaussians.skinned_covariance import skinned_covariance
from ihbench.methods.occgaussian.config import OccGaussianConfig
from ihbench.methods.occgaussian.decoder import FeatureDecoder
from ihbench.methods.occgaussian.pixel_features import PixelFeatures
from ihbench.methods.occgaussian.query import Query, make_query, neighbourhood

DECODER_SEED = 1  # added to the fit's, so that the two networks do not begin with the same numbers


@dataclass(frozen=True)
class Shown:
    """Attributes of all Gaussians as they are drawn."""

    colours: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    scales: Tensor  # [N, 3] m
    roughness: Tensor  # [] mean over queried Gaussians of Σ u_ij |c_i - c_j|₁


class OccGaussianAvatar(BigPoseAvatar[OccGaussianConfig]):
    """Buffers per vertex: `seen` and `hidden` views, and the memory, features summed over views by their weights."""

    kind, config_class = "occgaussian", OccGaussianConfig

    seen: Tensor  # [V] views that show it
    hidden: Tensor  # [V] views in which it is behind the occluder
    memory: Tensor  # [V, size]
    memory_weight: Tensor  # [V]

    def __init__(self, config: OccGaussianConfig, body: Body, seed: int):
        super().__init__(config, body, seed)
        features = config.features
        self.encoder = PixelFeatures(features, seed) if features.on else None
        self.decoder = None
        self._rest: DecodedCache[Shown] = DecodedCache()
        if features.on:
            count = len(body.v_template)
            self.decoder = FeatureDecoder(config.decoder, features.size, seed + DECODER_SEED)
            for name in ("seen", "hidden", "memory_weight"):
                self.register_buffer(name, torch.zeros(count))
            self.register_buffer("memory", torch.zeros(count, features.size))

    # --- who asks whom ---

    def candidates(self) -> NDArray[np.bool_]:
        """[V] vertices that may be asked: seen, with a feature, and with a Gaussian."""
        vertex = self.gaussians.carried(VERTEX)
        having = torch.zeros_like(self.seen, dtype=torch.bool)
        having[vertex] = True
        return (having & (self.seen > 0) & (self.memory_weight > 0)).cpu().numpy()

    def ask(
        self,
        more: NDArray[np.int64] | None = None,  # seen vertices that ask in this view, too
        without: NDArray[np.int64] | None = None,  # vertices that are not to be asked
    ) -> Query:
        """The query of all vertices that no view shows, and of `more`."""
        asking = (self.seen <= 0).cpu().numpy()
        if more is not None:
            asking[more] = True
        candidates = self.candidates()
        if without is not None:
            candidates[without] = False
        config = self.config.query
        return make_query(
            neighbourhood(self.body, config.same_part),
            np.flatnonzero(asking),
            candidates,
            self.seen.cpu().numpy(),
            neighbours=config.neighbours,
            sigma=config.sigma,
            device=self.device,
        )

    def features(self) -> Tensor:
        """[V, size] the memory; 0 for a vertex that no view shows."""
        return self.memory / self.memory_weight.clamp(min=1e-6)[:, None]

    # --- attributes ---

    def shown(self, query: Query, features: Tensor) -> Shown:  # features [V, size]
        """Attributes with the features of seen vertices and the query's answers for those that ask."""
        assert self.decoder is not None
        gaussians, vertex = self.gaussians, self.gaussians.carried(VERTEX)
        asks = torch.zeros(len(self.seen), device=self.device)
        asks[query.rows] = 1
        distance = torch.zeros_like(asks).index_copy(0, query.rows, query.distance)
        features = features.index_copy(0, query.rows, query.of(features))
        queried = asks[vertex]
        added = self.decoder(gaussians.means, features[vertex], queried, distance[vertex])
        colours = self.own_colours() + added.colours
        answers, known = self._asked_colours(query, colours.detach(), vertex)
        known = known[vertex] * queried
        # own colours have no evidence where a Gaussian asks
        colours = torch.where(known[:, None] > 0, answers[vertex] + added.colours, colours)
        return Shown(
            colours,
            (gaussians.opacity_logits + added.opacity_logits).sigmoid(),
            (gaussians.log_scales + added.log_scales).exp(),
            self._roughness(query, colours, known, vertex),
        )

    def own_colours(self) -> Tensor:
        """[N, 3] of the spherical harmonics of degree 0."""
        return self.gaussians.attributes[DC][:, 0] * Y00 + 0.5

    def _asked_colours(self, query: Query, colours: Tensor, vertex: Tensor) -> tuple[Tensor, Tensor]:
        """[V, 3] what each vertex that asks is told, and [V] whether there was anybody to ask."""
        told = torch.zeros(len(self.seen), 3, device=self.device)
        told[query.rows] = query.of(self._vertex_colours(colours, vertex))
        known = torch.zeros(len(self.seen), device=self.device)
        known[query.rows] = (query.weights.sum(1) > 0).float()
        return told, known

    def _vertex_colours(self, colours: Tensor, vertex: Tensor) -> Tensor:
        """[V, 3] mean over the Gaussians of each vertex."""
        count = len(self.seen)
        total = torch.zeros(count, 3, device=self.device).index_add(0, vertex, colours)
        number = torch.zeros(count, device=self.device).index_add(0, vertex, torch.ones_like(colours[:, 0]))
        return total / number.clamp(min=1)[:, None]

    def _roughness(self, query: Query, colours: Tensor, known: Tensor, vertex: Tensor) -> Tensor:
        chosen = (known > 0).nonzero()[:, 0]
        if not len(chosen):
            return colours.new_zeros(())
        place = torch.zeros(len(self.seen), dtype=torch.int64, device=self.device)
        place[query.rows] = torch.arange(len(query.rows), device=self.device)
        row = place[vertex[chosen]]
        asked = self._vertex_colours(colours.detach(), vertex)[query.index[row]]  # [n, k, 3]
        apart = (colours[chosen][:, None] - asked).abs().sum(2)
        return (query.weights[row] * apart).sum(1).mean()

    def at_rest(self) -> Shown:
        """Attributes without a training view, kept until a parameter or the memory changes."""
        state = np.array([self.memory.double().sum().item(), self.memory_weight.double().sum().item()])
        return self._rest.get(self, state.tobytes(), lambda: self.shown(self.ask(), self.features()))

    # --- drawing ---

    def drawn(self, posed: Posed, shown: Shown | None = None) -> PosedGaussians:
        """With attributes at rest unless others are given."""
        if self.decoder is None:
            return super().drawn(posed)
        shown = self.at_rest() if shown is None else shown
        coefficients = ((shown.colours - 0.5) / Y00)[:, None]
        above = (self.degree + 1) ** 2 - 1
        if above:
            coefficients = torch.cat([coefficients, self.gaussians.attributes[REST][:, :above]], 1)
        covariances = skinned_covariance(shown.scales, self.gaussians.quaternions, posed.linear)
        return PosedGaussians(
            posed.means, covariances, coefficients, None, shown.opacities, self.degree, posed.weights
        )
