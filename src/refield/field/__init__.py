"""A radiance field and how to see it. Tensors only, no files.            imports: scene"""
