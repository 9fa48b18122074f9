"""The whole laboratory in one process: its time, threads, processes and network are simulated, and a seed drives them.

`kernel` and `network` know nothing of zenpark; `test_conformance` compares the network with the real one.
"""
