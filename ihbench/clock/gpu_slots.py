"""Which graphics card each of several runs at a time is given: the cards' free memory decides, not the cores."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence

from ihbench.errors import BadInput

RUN_MEMORY = 12 * 2**30  # bytes that a run may want of its card: diffusion that learns at 512 px, and room to breathe
ASK = "import json, torch; c = torch.cuda; print(json.dumps([c.mem_get_info(k)[0] for k in range(c.device_count())]))"
VISIBLE = "CUDA_VISIBLE_DEVICES"


def card_slots(free: Sequence[int], runs: int, cores: int, workers: int | None = None) -> list[int]:
    """The card of each run that goes on at a time; as many as there are runs, cores and memory for, one at least.

    `free` is what is free of each card, bytes. `workers` fixes how many go on at a time, whatever the memory. Every
    further run goes to the card with the most memory left; of equal ones to the first. Raises `ValueError` without
    a card.
    """
    if not free:
        raise ValueError("cards: expected one or more")
    fitting = sum(memory // RUN_MEMORY for memory in free)
    count = max(1, min(runs, max(cores, 1), fitting) if workers is None else min(runs, workers))
    left, slots = list(free), []
    for _ in range(count):
        card = max(range(len(left)), key=lambda k: (left[k], -k))
        left[card] -= RUN_MEMORY
        slots.append(card)
    return slots


def free_memory() -> list[int]:
    """Bytes that are free of each card that torch sees. Asked in a process of its own, because asking
    takes memory of each. Raises `BadInput` where they do not say."""
    try:
        answer = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, timeout=300, check=True)
        free = json.loads(answer.stdout.splitlines()[-1])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError) as error:
        raise BadInput(f"--device cuda: the cards do not say how much of their memory is free ({error})") from error
    if not free:
        raise BadInput("--device cuda: torch sees no CUDA device here; leave --device out to fit on the CPU")
    return free


def only(card: int, environment: Mapping[str, str]) -> dict[str, str]:
    """The variable with which a process sees one of the cards that this one sees, as its first and only one."""
    seen = [name.strip() for name in environment.get(VISIBLE, "").split(",") if name.strip()]
    return {VISIBLE: seen[card] if card < len(seen) else str(card)}
