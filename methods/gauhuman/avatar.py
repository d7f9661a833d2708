"""GauHuman's avatar: `ihbench.fit.big_pose.avatar` with its configuration."""

from __future__ import annotations

from ihbench.fit.big_pose.avatar import BigPoseAvatar
from ihbench.methods.gauhuman.config import GauHumanConfig


class GauHumanAvatar(BigPoseAvatar[GauHumanConfig]):
    kind, config_class = "gauhuman", GauHumanConfig
