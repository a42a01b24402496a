// solver/xml.h - a small XML document as a tree (expat lives in xml.c only).
//
// Names are "local", or "namespace-uri local" where a namespace applies. Text is UTF-8. There is no document type declaration and
// so no entity but the five of XML itself: a file that has one is refused. Limits: 256 MiB, 64 levels, 2^21 elements.
#pragma once
#include <stddef.h>

struct xml_element {
    const char *name;
    char *text;              // all characters directly inside, pieced together; never NULL
    const char **attributes; // name, value, name, value, ..., NULL
    struct xml_element *parent, *first_child, *next;
    int line;
    struct xml_element *last_child; // while reading
    size_t n_text, text_capacity;
};

// *out is the root. 0, -EINVAL (logged with line and column), -EFBIG (logged), -ENOMEM.
int xml_parse(struct xml_element **out, const char *text, size_t n_bytes, const char *name_for_errors);
void xml_free(struct xml_element *root); // NULL allowed

// NULL where there is none. name NULL: any.
const struct xml_element *xml_child(const struct xml_element *e, const char *name); // the first; e may be NULL
const struct xml_element *xml_next(const struct xml_element *e, const char *name);  // the next sibling
const char *xml_attribute(const struct xml_element *e, const char *name);
