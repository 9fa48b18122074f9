"""Crazyflies, real or at the far end of a protocol twin, through cflib (GPL-3.0: imported when one is opened)."""
