"""How good a result is: errors of pictures, materials, light and geometry, each beside what a null would score."""
