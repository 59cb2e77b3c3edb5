"""Whole recordings, damaged in every way we could think of, through everything that reads them.

    OMP_NUM_THREADS=1 python -m benchmarks.robustness [--files 5000] [--seed 0]

`mcap_map` reads an intact file's structure with code of its own, `mutations` damages the file and knows which bytes are
still there, `hostile` writes files that are sound on the outside, and `trial` judges what a reader made of either.
"""
