"""Every fault of the catalogue in every state in which it can strike: what the cell made of it.

    python -m tests.benchmarks.fault_matrix --jobs 2 --record matrix.jsonl

Each field is a run of its own that sorts a small simulated table: a fault strikes as the cycle enters a state
(`cycle`), while an operated cell is STOPPED or in FAULT (`standing`), when the program comes up (`starting`), or kills
or hangs the whole process (`processes`). Prints a line a field and a summary; the exit code is 1 when a field ended
otherwise than the catalogue says, an object was lost or counted twice, or anything moved after a latched fault. With
`--record` it goes on where it was cut off.
"""
