"""From a raw scan to the template's vertices: pose, shape, free form, confidence."""
