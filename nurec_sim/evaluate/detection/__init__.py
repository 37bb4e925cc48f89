"""What a camera detector finds in rendered images, against the truth and against true images from the same poses."""
