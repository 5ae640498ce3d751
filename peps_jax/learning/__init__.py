"""What is learned: networks, replay, the dynamics T_A, the surrogate reward r-hat, and soft actor-critic."""
