"""Importers and checks of template anatomies: the built-in one, public ones, and folders."""
