"""The kinds of robots that are no device, a file each, registered in the group `zenpark.kinds`.

May import: agents.body, agents.vectors.
"""
