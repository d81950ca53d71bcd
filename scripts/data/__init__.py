"""Scripts that make the sample data, pictures, schemas, and the outputs in the documents."""
