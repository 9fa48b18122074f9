"""Every place where bytes from outside are read gets bytes that nobody meant: nothing may escape as a traceback.

`targets` lists the places, `mutate` spoils good examples, `fuzz` drives both. The ordinary tests try a few hundred
inputs on each (`test_fuzz`); `./zenpark test --all` a million in all (`python -m tests.fuzz`).
"""
