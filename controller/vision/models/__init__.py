"""Trained models: networks in ONNX files that a recipe names, and the small one that ships."""
