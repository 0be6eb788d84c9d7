"""Energies, assembly, factorisation and equilibrium."""
