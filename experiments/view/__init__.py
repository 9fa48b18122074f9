"""The view in a browser (`./zenpark view`): a live run as an observer sees it, a recording, or a paced virtual run.

Imports all of experiments but sweeps.
"""
