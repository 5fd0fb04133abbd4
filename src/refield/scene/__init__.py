"""What the world is: poses, cameras, photos, captures and changes. Facts only; imports nothing of ours."""
