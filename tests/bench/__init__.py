"""Benchmarks of zenpark beside other simulators, and of its growth; ratios within one run, kept out of the tests."""
