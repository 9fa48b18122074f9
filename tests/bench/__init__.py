"""Speed of zenpark (`./zenpark test --bench`), also beside other simulators; ratios within one run."""
