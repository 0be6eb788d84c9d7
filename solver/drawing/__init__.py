"""Drawing surfaces: an unhurried rasteriser, its light and colours, and sheets of pictures."""
