def with_age(text, root):
    return text
