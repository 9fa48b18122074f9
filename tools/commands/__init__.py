"""Commands, one file per subject: signatures and what they do.

May import: agents, twins, experiments, tools.completion, tools.consent, tools.live_table, tools.options,
tools.progress, tools.terminal.
"""
