"""Do annotators agree on which operation a checkpoint is?"""
