// solver/xml.c - expat's events put together to a tree.
//
// expat checks the form; what it would do on its own (entities, external files) is off because no document type is let in.
#include "solver/xml.h"
#include "solver/take/log.h"

#include <errno.h>
#include <expat.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_BYTES = 256 << 20, MAX_DEPTH = 64, MAX_ELEMENTS = 1 << 21 };

struct reading {
    XML_Parser parser;
    struct xml_element *root, *open;
    int n_elements, depth, err;
    const char *refused; // what we, not expat, object to
};

static void stop(struct reading *r, int err, const char *refused)
{
    r->err = err, r->refused = refused;
    XML_StopParser(r->parser, XML_FALSE);
}

// One block: the element, its attributes' pointers, its name and their strings.
static struct xml_element *new_element(const char *name, const char **attributes)
{
    size_t n_attributes = 0, n_chars = strlen(name) + 1;
    for (; attributes[n_attributes]; n_attributes++)
        n_chars += strlen(attributes[n_attributes]) + 1;
    struct xml_element *e = calloc(1, sizeof(*e) + (n_attributes + 1) * sizeof(char *) + n_chars);
    if (!e)
        return NULL;
    e->text = calloc(1, 1);
    e->attributes = (const char **)(e + 1);
    char *at = (char *)(e->attributes + n_attributes + 1);
    if (!e->text) {
        free(e);
        return NULL;
    }
    e->name = at;
    at = stpcpy(at, name) + 1;
    for (size_t i = 0; i < n_attributes; i++) {
        e->attributes[i] = at;
        at = stpcpy(at, attributes[i]) + 1;
    }
    return e;
}

static void XMLCALL on_start(void *arg, const char *name, const char **attributes)
{
    struct reading *r = arg;
    if (r->err)
        return;
    if (r->depth == MAX_DEPTH || r->n_elements == MAX_ELEMENTS) {
        stop(r, -EFBIG, r->depth == MAX_DEPTH ? "elements are nested deeper than 64 levels" : "more than 2^21 elements");
        return;
    }
    struct xml_element *e = new_element(name, attributes);
    if (!e) {
        stop(r, -ENOMEM, NULL);
        return;
    }
    e->line = (int)XML_GetCurrentLineNumber(r->parser);
    e->parent = r->open;
    if (!r->open)
        r->root = e;
    else if (r->open->last_child)
        r->open->last_child->next = e;
    else
        r->open->first_child = e;
    if (r->open)
        r->open->last_child = e;
    r->open = e;
    r->depth++, r->n_elements++;
}

static void XMLCALL on_end(void *arg, const char *name)
{
    struct reading *r = arg;
    (void)name;
    if (r->err)
        return;
    r->open = r->open->parent;
    r->depth--;
}

static void XMLCALL on_text(void *arg, const char *text, int n)
{
    struct reading *r = arg;
    struct xml_element *e = r->open;
    if (r->err || !e)
        return;
    if (e->n_text + (size_t)n >= e->text_capacity) {
        const size_t capacity = 2 * (e->n_text + (size_t)n) + 16;
        char *larger = realloc(e->text, capacity);
        if (!larger) {
            stop(r, -ENOMEM, NULL);
            return;
        }
        e->text = larger, e->text_capacity = capacity;
    }
    memcpy(e->text + e->n_text, text, (size_t)n);
    e->n_text += (size_t)n;
    e->text[e->n_text] = 0;
}

static void XMLCALL on_document_type(void *arg, const char *name, const char *system, const char *public, int has_subset)
{
    (void)name, (void)system, (void)public, (void)has_subset;
    stop(arg, -EINVAL, "a document type declaration (<!DOCTYPE ...>) is not read; remove it");
}

int xml_parse(struct xml_element **out, const char *text, size_t n_bytes, const char *name_for_errors)
{
    struct reading r = { 0 };
    *out = NULL;
    if (n_bytes > MAX_BYTES) {
        log_error("xml: %s: larger than 256 MiB", name_for_errors);
        return -EFBIG;
    }
    r.parser = XML_ParserCreateNS(NULL, ' ');
    if (!r.parser)
        return -ENOMEM;
    XML_SetUserData(r.parser, &r);
    XML_SetElementHandler(r.parser, on_start, on_end);
    XML_SetCharacterDataHandler(r.parser, on_text);
    XML_SetStartDoctypeDeclHandler(r.parser, on_document_type);
    if (XML_Parse(r.parser, text, (int)n_bytes, 1) != XML_STATUS_OK) {
        const enum XML_Error code = XML_GetErrorCode(r.parser);
        if (!r.err)
            r.err = code == XML_ERROR_NO_MEMORY ? -ENOMEM : -EINVAL;
        if (r.err != -ENOMEM)
            log_error("xml: %s:%lu:%lu: %s", name_for_errors, (unsigned long)XML_GetCurrentLineNumber(r.parser),
                      (unsigned long)XML_GetCurrentColumnNumber(r.parser) + 1,
                      r.refused                                ? r.refused
                      : code == XML_ERROR_NO_ELEMENTS          ? "the file ends inside an element or holds none: it is cut short"
                      : code == XML_ERROR_UNCLOSED_TOKEN       ? "the file ends inside a tag: it is cut short"
                                                               : XML_ErrorString(code));
    }
    XML_ParserFree(r.parser);
    if (r.err) {
        xml_free(r.root);
        return r.err;
    }
    *out = r.root;
    return 0;
}

void xml_free(struct xml_element *root)
{
    while (root) { // siblings by the loop, children by recursion: no deeper than 64
        struct xml_element *next = root->next;
        xml_free(root->first_child);
        free(root->text);
        free(root);
        root = next;
    }
}

static const struct xml_element *first_named(const struct xml_element *e, const char *name)
{
    while (e && name && strcmp(e->name, name))
        e = e->next;
    return e;
}

const struct xml_element *xml_child(const struct xml_element *e, const char *name)
{
    return e ? first_named(e->first_child, name) : NULL;
}

const struct xml_element *xml_next(const struct xml_element *e, const char *name)
{
    return first_named(e->next, name);
}

const char *xml_attribute(const struct xml_element *e, const char *name)
{
    for (const char **a = e ? e->attributes : NULL; a && *a; a += 2)
        if (!strcmp(a[0], name))
            return a[1];
    return NULL;
}
