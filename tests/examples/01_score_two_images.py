"""Score two images: PSNR, SSIM and FLIP over regions of your own, each number with its identity.

python 01_score_two_images.py prediction.png truth.png     # without files it makes two pictures of a disc
"""

import sys
from pathlib import Path

import numpy as np

from ihbench.files.images import read_image
from ihbench.metrics import evaluate, psnr

WHITE = (1.0, 1.0, 1.0)

if len(sys.argv) == 3:
    prediction, truth = (read_image(Path(name), WHITE) for name in sys.argv[1:])
    person = (np.asarray(truth, float) / 255 < 0.99).any(-1)  # whatever is not background
else:
    row, column = np.mgrid[:96, :96]
    person = (row - 48) ** 2 + (column - 48) ** 2 < 30**2  # [H, W] bool
    truth = np.where(person[..., None], np.float32([0.8, 0.3, 0.2]), np.float32(WHITE))
    prediction = np.clip(truth + np.random.default_rng(0).normal(0, 0.05, truth.shape).astype(np.float32), 0, 1)

whole, inside = psnr(prediction, truth), psnr(prediction, truth, person)
print(f"PSNR of the whole image: {whole:.2f} dB, of the person: {inside:.2f} dB")
for identity, score in evaluate(prediction, truth, {"full": None, "body": person}).items():
    print(f"{identity:50} {score.value:.4f}" if not score.absent else f"{identity:50} absent: {score.reason}")
