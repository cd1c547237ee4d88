/* One trial from C: fetch the widths for a reference torque, play them, wait for the end, fetch the recording.
 *
 *   gcc -std=c11 -Wall -Wextra -o controller examples/controller.c -lcurl -lcjson -lm
 *   STIMRIG_TOKEN=… ./controller http://127.0.0.1:8000 P017 trial.h5
 *
 * Needs libcurl and cJSON (Debian: libcurl4-openssl-dev, libcjson-dev). Every answer that is not 2xx ends the program
 * with the sentence of the service: it says what is wrong and what to do.
 */
#define _POSIX_C_SOURCE 200809L
#include <cjson/cJSON.h>
#include <curl/curl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

struct body {
    char *data;
    size_t size;
};

static size_t keep(char *part, size_t size, size_t count, void *into)
{
    struct body *body = into;
    char *grown = realloc(body->data, body->size + size * count + 1);
    if (grown == NULL)
        return 0; /* curl ends the request then */
    memcpy(grown + body->size, part, size * count);
    body->data = grown;
    body->size += size * count;
    body->data[body->size] = '\0';
    return size * count;
}

static void fail(const char *what, const char *why)
{
    fprintf(stderr, "%s: %s\n", what, why);
    exit(1);
}

static const char *text_of(const cJSON *object, const char *name)
{
    const cJSON *found = cJSON_GetObjectItemCaseSensitive(object, name);
    return cJSON_IsString(found) ? found->valuestring : NULL;
}

/* One request; `sent` is JSON, or NULL for GET. What comes is the caller's to free. */
static struct body ask(const char *url, const char *key, const char *path, const char *sent)
{
    struct body got = {NULL, 0};
    char address[512], authorization[256];
    long status = 0;
    struct curl_slist *head = NULL;
    CURL *curl = curl_easy_init();
    if (curl == NULL)
        fail(path, "libcurl cannot begin");
    snprintf(address, sizeof address, "%s%s", url, path);
    snprintf(authorization, sizeof authorization, "Authorization: Bearer %s", key);
    head = curl_slist_append(head, authorization);
    head = curl_slist_append(head, "Content-Type: application/json");
    curl_easy_setopt(curl, CURLOPT_URL, address);
    curl_easy_setopt(curl, CURLOPT_HTTPHEADER, head);
    curl_easy_setopt(curl, CURLOPT_WRITEFUNCTION, keep);
    curl_easy_setopt(curl, CURLOPT_WRITEDATA, &got);
    curl_easy_setopt(curl, CURLOPT_TIMEOUT, 60L);
    if (sent != NULL)
        curl_easy_setopt(curl, CURLOPT_POSTFIELDS, sent);
    CURLcode code = curl_easy_perform(curl);
    curl_easy_getinfo(curl, CURLINFO_RESPONSE_CODE, &status);
    curl_slist_free_all(head);
    curl_easy_cleanup(curl);
    if (code != CURLE_OK)
        fail(path, curl_easy_strerror(code));
    if (status < 200 || status > 299) {
        cJSON *problem = cJSON_Parse(got.data ? got.data : "");
        const char *detail = text_of(problem, "detail");
        fail(path, detail ? detail : "refused without a reason");
    }
    return got;
}

static cJSON *ask_json(const char *url, const char *key, const char *path, const char *sent)
{
    struct body got = ask(url, key, path, sent);
    cJSON *found = cJSON_Parse(got.data ? got.data : "");
    free(got.data);
    if (found == NULL)
        fail(path, "the answer is no JSON");
    return found;
}

/* The widths for two bells of torque, as segments of a trial. The caller frees it. */
static cJSON *plan(const char *url, const char *key, const char *model)
{
    enum { PULSES = 240 }; /* six seconds at 40 pulses a second */
    char path[256];
    cJSON *wanted = cJSON_CreateObject();
    cJSON *torque = cJSON_AddArrayToObject(wanted, "reference_torque_nm");
    for (int k = 0; k < PULSES; k++)
        cJSON_AddItemToArray(torque, cJSON_CreateNumber(0.5 * pow(sin(2 * 3.14159265358979 * k / PULSES), 2)));
    char *sent = cJSON_PrintUnformatted(wanted);
    snprintf(path, sizeof path, "/v1/models/%s/widths", model);
    cJSON *found = ask_json(url, key, path, sent);
    free(sent);
    cJSON_Delete(wanted);
    const cJSON *lacks = NULL;
    cJSON_ArrayForEach(lacks, cJSON_GetObjectItemCaseSensitive(found, "unreachable"))
        fprintf(stderr, "out of reach: %s\n", text_of(lacks, "reason"));
    cJSON *segments = cJSON_DetachItemFromObjectCaseSensitive(found, "segments");
    cJSON_Delete(found);
    return segments;
}

/* Play the trial; the id of its recording, which the caller frees. */
static char *play(const char *url, const char *key, const char *participant, cJSON *segments)
{
    char path[256];
    cJSON *body = cJSON_CreateObject();
    cJSON_AddStringToObject(body, "participant", participant);
    cJSON_AddStringToObject(body, "kind", "sequence");
    cJSON_AddItemToObject(body, "segments", segments);
    char *sent = cJSON_PrintUnformatted(body);
    cJSON *test = ask_json(url, key, "/v1/tests", sent);
    free(sent);
    cJSON_Delete(body);
    snprintf(path, sizeof path, "/v1/tests/%s", text_of(test, "id"));
    while (!cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(test, "done"))) {
        nanosleep(&(struct timespec){0, 200 * 1000 * 1000}, NULL);
        cJSON_Delete(test);
        test = ask_json(url, key, path, NULL);
    }
    if (strcmp(text_of(test, "state"), "completed") != 0)
        fail(text_of(test, "state"), text_of(test, "reason"));
    char *recording = strdup(text_of(test, "recording_id"));
    cJSON_Delete(test);
    return recording;
}

int main(int count, char **words)
{
    const char *key = getenv("STIMRIG_TOKEN");
    char path[256];
    if (count != 4 || key == NULL)
        fail("usage", "STIMRIG_TOKEN=… controller URL PARTICIPANT FILE.h5");
    curl_global_init(CURL_GLOBAL_DEFAULT);
    snprintf(path, sizeof path, "/v1/participants/%s/model", words[2]);
    cJSON *model = ask_json(words[1], key, path, NULL);
    char *recording = play(words[1], key, words[2], plan(words[1], key, text_of(model, "model_id")));
    snprintf(path, sizeof path, "/v1/recordings/%s", recording);
    struct body file = ask(words[1], key, path, NULL);
    FILE *out = fopen(words[3], "wb");
    if (out == NULL || fwrite(file.data, 1, file.size, out) != file.size || fclose(out) != 0)
        fail(words[3], "cannot be written");
    printf("%s: %zu bytes\n", words[3], file.size);
    free(file.data);
    free(recording);
    cJSON_Delete(model);
    curl_global_cleanup();
    return 0;
}
