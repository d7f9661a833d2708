"""The course of score distillation: noise range and photos' weight by SDS step, from 1 (gtu/guidance, 955-1035)."""

from __future__ import annotations

from ihbench.methods.gtu.config import GtuConfig

FIRST, SECOND, THIRD = (0.5, 0.98), (0.3, 0.98), (0.02, 0.3)  # lowest and highest share of the model's noise steps


def sds_step(config: GtuConfig, iteration: int) -> int | None:
    """Number of the SDS step that iteration `iteration`, from 1, ends with; None where it has none."""
    since = iteration - config.photo_steps
    if not config.sds or since < 1 or (since - 1) % config.sds_every:
        return None
    return 1 + (since - 1) // config.sds_every


def noise_range(config: GtuConfig, k: int) -> tuple[float, float]:
    """Lowest and highest share of the noise steps in SDS step k; in the second stage the highest falls linearly."""
    if k < config.second_stage:
        return FIRST
    if k >= config.third_stage:
        return THIRD
    done = (k - config.second_stage) / (config.third_stage - config.second_stage)
    lowest, highest = SECOND
    return lowest, highest + done * (lowest - highest)


def photo_weight(config: GtuConfig, iteration: int) -> float:
    """λ: 1 while there are photos alone, then the gain times the square of the noise range's upper end."""
    since = iteration - config.photo_steps
    if not config.sds or since < 1:
        return 1.0
    k = 1 + (since - 1) // config.sds_every  # the step of this iteration, or the last before it
    return config.photo_gain * noise_range(config, k)[1] ** 2
