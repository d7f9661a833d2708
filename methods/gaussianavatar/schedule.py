"""What changes over a fit: step sizes, the drawn scale, the weights of offset and LPIPS. Pure functions of the step.

Steps are counted from 0 as they are begun; the released code counts iterations and epochs from 1.
"""

from __future__ import annotations

from ihbench.methods.gaussianavatar.config import GaussianAvatarConfig

MILESTONES = (66, 133)  # of a run of 200 epochs; the released code counts iterations (avatar_model.py:155, 266-267)
RELEASED_EPOCHS = 200
FALL = 0.1  # of the step sizes at each milestone
OFFSET_FALL, OFFSET_EPOCHS = 0.85, 20  # general_utils.py:261-280


def steps_of(config: GaussianAvatarConfig, batches: int) -> int:
    """Steps of stage 1 with so many batches an epoch."""
    return config.steps or config.epochs * batches


def epoch_of(config: GaussianAvatarConfig, step: int, steps: int) -> int:
    """The epoch, from 1, that a step of `steps` falls in."""
    return step * config.epochs // steps + 1


def rate_share(config: GaussianAvatarConfig, step: int, steps: int) -> float:
    """Of the step sizes' start, what a step takes."""
    if config.schedule == "released":
        passed = sum(step >= milestone for milestone in MILESTONES)
    else:
        epoch = epoch_of(config, step, steps) * RELEASED_EPOCHS / config.epochs
        passed = sum(epoch > milestone for milestone in MILESTONES)
    return FALL**passed


def scale_share(config: GaussianAvatarConfig, step: int) -> float:
    """Of the decoded scale, what a step draws."""
    return min((step + 1) / config.scale_ramp, 1.0)


def offset_weight(config: GaussianAvatarConfig, epoch: int) -> float:
    """λ_e."""
    return config.offset_weight * OFFSET_FALL ** (epoch // OFFSET_EPOCHS)


def lpips_weight(config: GaussianAvatarConfig, epoch: int) -> float:
    return config.lpips if epoch >= config.lpips_epoch else 0.0
