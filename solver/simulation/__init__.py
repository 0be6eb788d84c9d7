"""A face in motion: equilibria and time steps with contact and forces."""
