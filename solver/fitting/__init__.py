"""Targets, regularisers and the solvers that fit activations and muscle geometry."""
