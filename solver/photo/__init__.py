"""Photographs: cameras, landmarks on the skin, and the fit of a face to what a picture shows."""
