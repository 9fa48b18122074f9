"""The experiment: its file, its check, its two clocks, its recording and its report."""
