"""The whole laboratory in one process: its time, threads, processes and network are simulated, and a seed drives them.

`kernel`, `links`, `entities`, `network` and `advanced` know nothing of zenpark; `test_conformance` compares them with a
real network.
"""
