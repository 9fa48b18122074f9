import os

from agents.runtime.command_line import Output


def test_it_prints(pipe):
    print("über", 1, file=Output(pipe[1]), flush=True)
    assert os.read(pipe[0], 100).decode() == "über 1\n"


def test_nobody_reads(pipe):
    os.close(pipe.pop(0))
    print("x", file=Output(pipe[0]), flush=True)


def test_slow_reader_costs_no_time(pipe):
    out = Output(pipe[1])
    for _ in range(100):
        print("x" * 4000, file=out)  # a pipe holds 64 kB: a print that waited would wait for ever
    assert len(os.read(pipe[0], 1 << 20)) >= 4096
