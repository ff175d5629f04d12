"""Sweeps, baselines, and everything that docs/results.md shows. Ten minutes' reading, in this order:

engine.py     a run is a frozen config with one folder, named by its hash; runs become rows of one table.csv
captures.py   what runs work on: built-in captures made on demand, or a folder of the user's
scenes.py     a capture as arrays, the initial scene that all methods share, and the one scorer
baselines/    one small file per method: this system, and what it is compared with
curves.py     speed against error of single rooms: renderer, registration, localisation, fit
stability.py  float32 against float64 over what makes numbers hard
tables.py     which runs make which table and plot; `python -m experiments.tables --preset fast`
bench.py      the gate: a committed baseline, and whether today's errors and times keep to it

The other files here are benchmarks of one room each, and converters of real data sets.
"""
