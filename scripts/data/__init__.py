"""What makes the sample data, pictures, schemas and outputs in the documents."""
