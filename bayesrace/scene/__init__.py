"""What viewers such as Foxglove and Lichtblick draw of a run, made of its messages.

Order: the schemas that the viewers know (schemas.py), the scene (drawing.py), panels for it
(layout.json).
"""

from bayesrace.scene.drawing import SCENE, Drawn, Scene
from bayesrace.scene.schemas import schema_name, schema_text

__all__ = ["SCENE", "Drawn", "Scene", "schema_name", "schema_text"]
