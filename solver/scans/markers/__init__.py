"""Markers on a face: takes as files have them, and where each marker sits on a person."""
