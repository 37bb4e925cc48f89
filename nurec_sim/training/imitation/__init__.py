"""Training of the end-to-end policies by imitation: a driver that sees the truth answers, a network sees images."""
