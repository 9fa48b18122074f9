"""The kinds of robots that come along, a file each, registered in the group `zenpark.kinds`.

May import: agents.body, agents.protocols, agents.vectors.
"""
