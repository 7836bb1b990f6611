"""A bow thruster after Healey et al. (1995): equations, sensors, disturbances, envs, controllers."""
