"""A Crazyflie 2.x at the far end of a wire: CRTP over UDP, to which an unmodified cflib connects."""
