"""NuRec archives: state, layers, and the JSON files beside them."""
