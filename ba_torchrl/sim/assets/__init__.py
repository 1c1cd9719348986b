"""Sets of objects: PyBullet's random shapes, procedural household items, folders of meshes."""
