"""Object sets: PyBullet random shapes, household items and folders of meshes."""
