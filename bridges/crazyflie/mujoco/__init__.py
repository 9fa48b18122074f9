"""Rigid quadrotors in MuJoCo, under a rebuilt cascade of the Crazyflie's firmware: the engine `mujoco`.

May import: agents, twins.
"""
