"""Skins over time: few shapes that span them, files of frames, and what these show read back."""
