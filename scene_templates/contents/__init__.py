"""What is in a room and around it: objects, surfaces, lights, cameras."""
