"""Training of the camera detector in procedural towns."""
