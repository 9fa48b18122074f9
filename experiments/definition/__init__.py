"""What an experiment is: the structs of its file, and what follows from them for robots, bodies and network.

Imports agents, twins.
"""
