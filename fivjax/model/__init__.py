"""What is simulated: structure, friction law, load, scene."""
