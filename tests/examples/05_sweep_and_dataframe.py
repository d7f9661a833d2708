"""A sweep, and its numbers as a DataFrame: how much quality more steps buy.

    python 05_sweep_and_dataframe.py [PROTOCOL]

The avatar is made tiny, so that the example takes seconds. A finished run is found and not repeated.
"""

import sys

import ihbench

PROTOCOL = sys.argv[1] if len(sys.argv) > 1 else "zju_occ"
TINY = {"texels": 32, "levels": (16,), "decoder_width": 32, "position_map": 16, "inpaint.on": False}

if __name__ == "__main__":
    runs = [ihbench.run(PROTOCOL, "standin-1", steps=steps, image_size=64, **TINY) for steps in (4, 64)]
    for run in runs:
        print(f"{run.switches['steps']} steps: {run.status} in {run.fit_seconds:.1f} s, {run.folder}")

    table = ihbench.frame("runs")  # a line for every view, row, metric and region
    own = table[(table["row"] == "inpainthuman") & (table["metric"] == "psnr")]
    print(own.pivot_table(index="digest", columns="region", values="value", sort=False).round(2).to_string())
    assert set(own["digest"]) == {run.record.digest for run in runs}
