"""What is expected of the parameters of the joint model."""
